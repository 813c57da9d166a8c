"""ConvLSTM as a graph of ONNX, with random weights.

Shi, Chen, Wang, Yeung, Wong & Woo, "Convolutional LSTM Network: A Machine Learning Approach for Precipitation Nowcasting", NIPS
2015, table 1, for Moving MNIST: frames of 64×64 px in patches of 4×4 (16×16×16), three layers with 128, 64 and 64 channels, 5×5
kernels from input to state and from state to state, peepholes; a forecaster of the same layers in reverse order that starts with
the encoder's states and has no other input; a 1×1 convolution from all its states. 7,585,296 parameters.
"""

from __future__ import annotations

import numpy as np
import onnx
from foreframe.export_onnx.graph import Graph, Tensor, Value, concat
from foreframe.export_onnx.layers import sigmoid

from random_weights import RandomWeights

SIDE, PATCH, KERNEL, HIDDEN = 64, 4, 5, (128, 64, 64)
PLACES = SIDE // PATCH


class _Layer:
    """A peephole layer; its state is 0 at first."""

    def __init__(self, weights: RandomWeights, inputs: int, hidden: int) -> None:
        self.weight, self.bias = weights.convolution(KERNEL, inputs + hidden, 4 * hidden)
        self.peepholes = [weights.vector(hidden).reshape(1, hidden, 1, 1) for _ in range(3)]
        self.hidden, self.inputs = hidden, inputs
        self.h: Value = np.zeros((1, hidden, PLACES, PLACES))
        self.c: Value = np.zeros((1, hidden, PLACES, PLACES))

    def step(self, x: list[Tensor]) -> Tensor:
        read = concat([*x, self.h])
        pads = 4 * [KERNEL // 2]
        sums = read.graph.node("Conv", read, self.weight, self.bias, pads=pads)
        i, f, g, o = (sums[:, gate * self.hidden : (gate + 1) * self.hidden] for gate in range(4))
        i = sigmoid(i + self.peepholes[0] * self.c)
        f = sigmoid(f + self.peepholes[1] * self.c)
        self.c = f * self.c + i * np.tanh(g)
        self.h = sigmoid(o + self.peepholes[2] * self.c) * np.tanh(self.c)
        return self.h


def conv_lstm(context: int, horizon: int) -> tuple[onnx.ModelProto, int]:
    """The graph and its number of parameters. It takes ``frames [batch, context, 64, 64]``."""
    weights, graph = RandomWeights(), Graph()
    encoder = [_Layer(weights, inputs, hidden) for inputs, hidden in zip((PATCH * PATCH, *HIDDEN), HIDDEN)]
    forecaster = [_Layer(weights, inputs, hidden) for inputs, hidden in zip((0, *HIDDEN[::-1]), HIDDEN[::-1])]
    output = weights.convolution(1, sum(HIDDEN), PATCH * PATCH)
    frames = graph.input("frames", ["batch", context, SIDE, SIDE], "oldest first")
    for at in range(context):
        x = graph.node("SpaceToDepth", frames[:, at].reshape(-1, 1, SIDE, SIDE), blocksize=PATCH)
        for layer in encoder:
            x = layer.step([x])
    for layer, seen in zip(forecaster, encoder[::-1]):
        layer.h, layer.c = seen.h, seen.c
    predicted = []
    for _ in range(horizon):
        states: list[Tensor] = []
        for layer in forecaster:
            states.append(layer.step(states[-1:]))
        patches = sigmoid(graph.node("Conv", concat(states), *output))
        predicted.append(graph.node("DepthToSpace", patches, blocksize=PATCH))
    graph.output("predicted", concat(predicted), ["batch", horizon, SIDE, SIDE], "the next frames")
    return graph.model("ConvLSTM", {}), weights.count
