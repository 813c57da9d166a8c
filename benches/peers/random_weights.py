"""Random weights, counted. Times do not depend on what a network has learned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class RandomWeights:
    def __init__(self) -> None:
        self.count, self._random = 0, np.random.default_rng(1)

    def convolution(self, side: int, inputs: int, outputs: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Weight ``[outputs, inputs, side, side]`` and bias."""
        scale = 1 / np.sqrt(inputs * side * side)
        return scale * self._drawn(outputs, inputs, side, side), self.vector(outputs)

    def transposed(self, side: int, inputs: int, outputs: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Of a transposed convolution: weight ``[inputs, outputs, side, side]`` and bias."""
        weight, bias = self.convolution(side, inputs, outputs)
        return weight.transpose(1, 0, 2, 3), bias

    def vector(self, length: int) -> NDArray[np.float64]:
        return 0.1 * self._drawn(length)

    def _drawn(self, *shape: int) -> NDArray[np.float64]:
        self.count += int(np.prod(shape))
        return self._random.normal(size=shape)
