"""What is timed: graphs with their inputs, the products that they need, and Foreframe's own bench of the same."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from cdna import cdna
from conv_lstm import conv_lstm
from foreframe.export_onnx import export_onnx
from foreframe.export_onnx.dense import DenseNetwork
from foreframe.export_onnx.graph import Graph
from foreframe.export_onnx.model_directory import ModelDirectory
from numpy.typing import NDArray

CONTEXT = HORIZON = 5
#: Of a predicted frame, as crates/core/src/nn/costs.rs counts them.
CONV_LSTM_MULTIPLY_ADDS, CDNA_MULTIPLY_ADDS = 1941e6, 3165e6
CONV_LSTM_PARAMETERS, CDNA_PARAMETERS = 7_585_296, 8_309_126


@dataclass(frozen=True, eq=False)
class Case:
    """A call that is timed."""

    title: str
    model: onnx.ModelProto
    batch: int
    #: Of the whole call.
    multiply_adds: float
    #: The line of Foreframe's benches that measures the same, if one does.
    bench: str | None = None

    def inputs(self) -> dict[str, NDArray[np.float32]]:
        """Random frames, and small random numbers as states and actions."""
        random = np.random.default_rng(1)
        given = {}
        for value in self.model.graph.input:
            sizes = [dimension.dim_value or self.batch for dimension in value.type.tensor_type.shape.dim]
            given[value.name] = (random.random(sizes) * (1 if "frame" in value.name else 0.3)).astype(np.float32)
            if value.name == "camera":
                given[value.name] = np.tile(np.array([1.2, 0.2, 0.6], np.float32), (self.batch, 1))
        return given


def all_cases(models: Path) -> list[Case]:
    """The dense and the flow networks, then the published ones."""
    window, step, products = _dense(models / "static")
    found = [
        Case(f"dense, {batch} window{'s' * (batch > 1)}", window, batch, products * batch, f"dense prediction of {batch} windows")
        for batch in (1, 64)
    ]
    # The step encodes one frame of the context instead of all.
    saved = (CONTEXT - 1) * 64 * 64 * 128
    found.append(Case("dense, a step of a stream", step, 1, products - saved, "dense step of a stream"))
    benches = {1: "window", 8: "8 windows"}
    for name, batches in (("moving-flow", (1, 8, 64)), ("rooms", (1, 8))):
        directory = ModelDirectory(models / name)
        model, products = export_onnx(models / name), HORIZON * directory.manifest["multiply_adds_per_frame"]
        for batch in batches:
            bench = f"{name} {benches[batch]}" if batch in benches else "flow prediction of 64 windows"
            found.append(Case(f"`{name}`, {batch} window{'s' * (batch > 1)}", model, batch, products * batch, bench))
    for title, (model, parameters), published, products in (
        ("ConvLSTM", conv_lstm(CONTEXT, HORIZON), CONV_LSTM_PARAMETERS, CONV_LSTM_MULTIPLY_ADDS),
        ("CDNA", cdna(CONTEXT, HORIZON), CDNA_PARAMETERS, CDNA_MULTIPLY_ADDS),
    ):
        assert parameters == published, f"{title} has {parameters} parameters"
        found.append(Case(f"{title}, 1 window", model, 1, HORIZON * products))
    return found


def _dense(directory: Path) -> tuple[onnx.ModelProto, onnx.ModelProto, float]:
    """Window and step without smoothing and inverting, which Foreframe's bench of the network leaves out too."""
    model = ModelDirectory(directory)
    model.spec["preprocess"] = {"blur_sigma_px": 0.0, "invert": False}
    window, step = Graph(), Graph()
    DenseNetwork(model).add_window(window)
    DenseNetwork(model).add_step(step)
    return window.model("dense", {}), step.model("dense-step", {}), HORIZON * model.manifest["multiply_adds_per_frame"]
