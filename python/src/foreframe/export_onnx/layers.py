"""The layers that the networks have in common. Images are ``[rows, channels, height, width]``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .graph import Tensor, Value
from .model_directory import Weights

_LEAST_STD = 1e-3
#: Standard deviations from the mean to which values are limited.
_MOST_STDS = 1e6


class Layers:
    """The layers of a model, by the names of their weights."""

    def __init__(self, weights: Weights) -> None:
        self.weights = weights

    def dense(self, x: Tensor, name: str) -> Value:
        return x @ self.weights[name + ".weight"] + self.weights[name + ".bias"]

    def at_each_place(self, x: Tensor, name: str) -> Tensor:
        """The dense layer, at each place of an image on its own."""
        weight = self.weights[name + ".weight"].T[:, :, None, None]
        return x.graph.node("Conv", x, weight, self.weights[name + ".bias"])

    def conv3(self, x: Tensor, name: str, stride: int = 1, dilation: int = 1) -> Tensor:
        """A 3×3 convolution with zero padding."""
        weight, bias = self.weights[name + ".weight"], self.weights[name + ".bias"]
        taps = weight.reshape(3, 3, -1, len(bias)).transpose(3, 2, 0, 1)
        spread = [dilation, dilation]
        return x.graph.node("Conv", x, taps, bias, pads=2 * spread, strides=[stride, stride], dilations=spread)


def sigmoid(x: Tensor) -> Tensor:
    return x.graph.node("Sigmoid", x)


def silu(x: Tensor) -> Value:
    return x * sigmoid(x)


def shuffle(x: Tensor) -> Tensor:
    """Four groups of channels to the four places of each 2×2 block."""
    return x.graph.node("DepthToSpace", x, blocksize=2)


def unshuffle(x: Tensor) -> Tensor:
    return x.graph.node("SpaceToDepth", x, blocksize=2)


def block_mean(x: Tensor, stride: int = 2) -> Tensor:
    """The mean of 2×2 pixels."""
    return x.graph.node("AveragePool", x, kernel_shape=[2, 2], strides=[stride, stride])


def _mean_and_std(channels: Sequence[Mapping[str, Any]]) -> tuple[Value, Value]:
    mean = np.array([channel["mean"] for channel in channels], np.float32)
    return mean, np.array([max(channel["std"], _LEAST_STD) for channel in channels], np.float32)


def scaled(values: Value, channels: Sequence[Mapping[str, Any]]) -> Value:
    """(value − mean) / std along the last axis; a std below the least counts as the least."""
    mean, std = _mean_and_std(channels)
    return (values - mean) / std


def limited(values: Value, channels: Sequence[Mapping[str, Any]]) -> Value:
    """At most a million standard deviations from the mean."""
    mean, std = _mean_and_std(channels)
    return np.minimum(np.maximum(values, mean - _MOST_STDS * std), mean + _MOST_STDS * std)
