"""CDNA as a graph of ONNX, with random weights.

Finn, Goodfellow & Levine, "Unsupervised Learning for Physical Interaction through Video Prediction", NIPS 2016, figure 1; skips
and kernel sizes as in the program that its authors released: seven convolutional LSTMs of 32, 32, 64, 64, 128, 64 and 32 channels
with 5×5 kernels, ten 5×5 kernels that move the last frame's pixels, a generated picture, and eleven masks. Frames are gray, 64×64
px. Its normalization layers and its prediction of the next state are left out, so it takes longer than measured here. 8.31 million
parameters.
"""

from __future__ import annotations

import numpy as np
import onnx
from foreframe.export_onnx.graph import Graph, Tensor, Value, concat, total
from foreframe.export_onnx.layers import sigmoid

from random_weights import RandomWeights

SIDE, KERNEL, MOVED, MASKS, KNOWN = 64, 5, 10, 11, 8


class _ConvLstm:
    def __init__(self, weights: RandomWeights, inputs: int, hidden: int, side: int) -> None:
        self.weight, self.bias = weights.convolution(KERNEL, inputs + hidden, 4 * hidden)
        self.hidden = hidden
        self.h: Value = np.zeros((1, hidden, side, side))
        self.c: Value = np.zeros((1, hidden, side, side))

    def step(self, x: Tensor) -> Tensor:
        read = concat([x, self.h])
        sums = read.graph.node("Conv", read, self.weight, self.bias, pads=4 * [KERNEL // 2])
        i, g, f, o = (sums[:, gate * self.hidden : (gate + 1) * self.hidden] for gate in range(4))
        self.c = sigmoid(f + 1) * self.c + sigmoid(i) * np.tanh(g)
        self.h = sigmoid(o) * np.tanh(self.c)
        return self.h


class _Network:
    """The layers; :meth:`step` predicts the frame after one."""

    def __init__(self, weights: RandomWeights) -> None:
        half, quarter, eighth = SIDE // 2, SIDE // 4, SIDE // 8
        self.enter = weights.convolution(5, 1, 32)
        self.lstm = [_ConvLstm(weights, 32, 32, half), _ConvLstm(weights, 32, 32, half)]
        self.shrink = [weights.convolution(3, 32, 32), weights.convolution(3, 64, 64)]
        self.lstm += [_ConvLstm(weights, 32, 64, quarter), _ConvLstm(weights, 64, 64, quarter)]
        self.known = weights.convolution(1, 64 + KNOWN, 64)
        self.lstm += [_ConvLstm(weights, 64, 128, eighth), _ConvLstm(weights, 128, 64, quarter), _ConvLstm(weights, 96, 32, half)]
        self.enlarge = [weights.transposed(3, channels, channels) for channels in (128, 96, 64)]
        self.generated, self.masks = weights.convolution(1, 64, 1), weights.convolution(1, 64, MASKS)
        self.kernels = weights.convolution(eighth, 128, MOVED * KERNEL * KERNEL)

    def step(self, frame: Tensor, known: Tensor) -> Tensor:
        node = frame.graph.node

        def halved(x: Tensor, layer: tuple[Value, Value]) -> Value:
            side = layer[0].shape[-1]
            return np.maximum(node("Conv", x, *layer, strides=[2, 2], pads=4 * [side // 2]), 0)

        def doubled(x: Tensor, layer: tuple[Value, Value]) -> Value:
            return np.maximum(node("ConvTranspose", x, *layer, strides=[2, 2], pads=[1, 1, 1, 1], output_padding=[1, 1]), 0)

        entered = halved(frame, self.enter)
        at_quarter = halved(self.lstm[1].step(self.lstm[0].step(entered)), self.shrink[0])
        at_eighth = halved(self.lstm[3].step(self.lstm[2].step(at_quarter)), self.shrink[1])
        everywhere = known + np.zeros((1, 1, SIDE // 8, SIDE // 8))
        hidden = self.lstm[4].step(np.maximum(node("Conv", concat([at_eighth, everywhere]), *self.known), 0))
        x = self.lstm[5].step(doubled(hidden, self.enlarge[0]))
        x = self.lstm[6].step(doubled(concat([x, at_quarter]), self.enlarge[1]))
        x = doubled(concat([x, entered]), self.enlarge[2])
        generated = sigmoid(node("Conv", x, *self.generated))
        masks = node("Softmax", node("Conv", x, *self.masks), axis=1)
        kernels = np.maximum(node("Conv", hidden, *self.kernels).reshape(-1, MOVED, KERNEL * KERNEL), 0) + 1e-12
        moved = self._moved(frame, kernels / total(kernels, 2))
        # Eleven masks: the frame, the generated picture and nine of the ten moved pictures, as in the authors' program.
        return total(masks * concat([frame, generated, moved[:, : MASKS - 2]]), 1)

    def _moved(self, frame: Tensor, kernels: Tensor) -> Tensor:
        """The frame by each window's own kernels."""
        pad = KERNEL // 2
        padded = frame.graph.node("Pad", frame, np.array(2 * [0, 0, pad, pad]))
        taps = [padded[:, :, row : row + SIDE, column : column + SIDE] for row in range(KERNEL) for column in range(KERNEL)]
        pixels: Value = kernels @ concat(taps).reshape(-1, KERNEL * KERNEL, SIDE * SIDE)
        return pixels.reshape(-1, MOVED, SIDE, SIDE)


def cdna(context: int, horizon: int) -> tuple[onnx.ModelProto, int]:
    """The graph and its number of parameters. ``known``: 8 numbers of state and action at each step."""
    weights, graph = RandomWeights(), Graph()
    network, steps = _Network(weights), context + horizon - 1
    frames = graph.input("frames", ["batch", context, SIDE, SIDE], "oldest first")
    known = graph.input("known", ["batch", steps, KNOWN], "state and action")
    frame, predicted = frames[:, 0].reshape(-1, 1, SIDE, SIDE), []
    for at in range(steps):
        if at < context:
            frame = frames[:, at].reshape(-1, 1, SIDE, SIDE)
        frame = network.step(frame, known[:, at].reshape(-1, KNOWN, 1, 1))
        if at >= context - 1:
            predicted.append(frame)
    graph.output("predicted", concat(predicted), ["batch", horizon, SIDE, SIDE], "the next frames")
    return graph.model("CDNA", {}), weights.count
