"""The dense network (docs/dense-network.md): its window, and its step of a stream."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .graph import Graph, Tensor, Value, clip, concat
from .inputs import Inputs
from .layers import Layers, scaled, sigmoid
from .model_directory import ModelDirectory


class _Cell(NamedTuple):
    """The state of an LSTM cell; 0 before the first step."""

    h: Value
    c: Value


class DenseNetwork:
    """Encodes frames as features, and predicts the features of the next ones."""

    def __init__(self, model: ModelDirectory) -> None:
        self.spec: dict[str, Any] = model.spec
        self.layers = Layers(model.weights)
        self.shape = (int(self.spec["frame_height_px"]), int(self.spec["frame_width_px"]))

    def add_window(self, graph: Graph) -> None:
        """All frames of the context in, the predicted frames out."""
        frames = graph.input("frames", ["batch", self.spec["context"], *self.shape], "oldest first, 0 to 1")
        self._add_prediction(graph, self._features(frames, self.spec["context"]))

    def add_step(self, graph: Graph) -> None:
        """One frame and the features of those before it in; the predicted frames and the features for the next step out."""
        context, features = self.spec["context"], self.spec["features"]
        frame = graph.input("frame", ["batch", *self.shape], "the newest, 0 to 1")
        about = "features of the frames before it, oldest first; 0 at first"
        past = graph.input("past_features", ["batch", context - 1, features], about)
        seen = concat([past, self._features(frame, 1)])
        self._add_prediction(graph, seen)
        about = "past_features of the next step"
        graph.output("next_features", seen[:, 1:], ["batch", context - 1, features], about)

    def _add_prediction(self, graph: Graph, seen: Tensor) -> None:
        horizon = self.spec["horizon"]
        features = self._predicted_features(seen, Inputs(graph, self.spec))
        values = clip(self.layers.dense(features, "frame_decoder"), 0, 1)
        frames = (1 - values if self.spec["preprocess"]["invert"] else values).reshape(-1, horizon, *self.shape)
        graph.output("predicted", frames, ["batch", horizon, *self.shape], "the next frames, 0 to 1")

    def _features(self, frames: Tensor, count: int) -> Value:
        """Features of each frame ``[batch, count, features]``."""
        values = self._smoothed(frames.reshape(-1, 1, *self.shape))
        values = 1 - values if self.spec["preprocess"]["invert"] else values
        return np.tanh(self.layers.dense(values.reshape(-1, count, self.shape[0] * self.shape[1]), "frame_encoder"))

    def _smoothed(self, image: Tensor) -> Tensor:
        """Gaussian smoothing; beyond the edges, the edge's pixels repeat."""
        sigma = self.spec["preprocess"]["blur_sigma_px"]
        if sigma <= 0:
            return image
        radius = int(np.ceil(3 * sigma))
        kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
        kernel /= kernel.sum()
        padded = image.graph.node("Pad", image, np.array(2 * [0, 0, radius, radius]), mode="edge")
        along_rows = image.graph.node("Conv", padded, kernel.reshape(1, 1, 1, -1))
        return image.graph.node("Conv", along_rows, kernel.reshape(1, 1, -1, 1))

    def _predicted_features(self, seen: Tensor, inputs: Inputs) -> Tensor:
        """Features of the next frames ``[batch, horizon, features]``."""
        cell = _Cell(0, 0)
        for step in range(self.spec["context"]):
            cell = self._lstm_step(seen[:, step], cell, "encoder")
        features, predicted = seen[:, -1], []
        state = [scaled(inputs.state, self.spec["states"])] if inputs.state is not None else []
        for step in range(self.spec["horizon"]):
            action = [scaled(inputs.actions[:, step], self.spec["actions"])] if inputs.actions is not None else []
            cell = self._lstm_step(concat([features, *action, *state]), cell, "predictor")
            output = self.layers.dense(cell.h, "predictor.output")
            features = output if self.spec.get("predictor_output") == "absolute" else features + output
            predicted.append(features.reshape(-1, 1, self.spec["features"]))
        return concat(predicted)

    def _lstm_step(self, x: Tensor, cell: _Cell, name: str) -> _Cell:
        """One step of the cell with peepholes; gate order i, f, c, o."""
        tensors, hidden = self.layers.weights, self.spec["hidden"]
        from_before = cell.h @ tensors[name + ".w_h"] if isinstance(cell.h, Tensor) else 0
        sums = x @ tensors[name + ".w_x"] + tensors[name + ".bias"] + from_before
        i, f, g, o = (sums[:, gate * hidden : (gate + 1) * hidden] for gate in range(4))
        i = sigmoid(i + tensors[name + ".peephole_i"] * cell.c)
        f = sigmoid(f + tensors[name + ".peephole_f"] * cell.c)
        c = f * cell.c + i * np.tanh(g)
        o = sigmoid(o + tensors[name + ".peephole_o"] * c)
        return _Cell(o * np.tanh(c), c)
