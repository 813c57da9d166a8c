"""Exports a model as ONNX, so that other programs predict with it; needs the extra ``foreframe[onnx]``.

``python -m foreframe.export_onnx MODEL_DIRECTORY OUT.onnx [--step]``
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import onnx
from onnx.checker import ValidationError
from onnx.shape_inference import InferenceError

from .dense import DenseNetwork
from .depth import DepthNetwork
from .flow import FlowNetwork
from .graph import Graph
from .model_directory import ModelDirectory, UnsupportedModel

__all__ = ["UnsupportedModel", "export_onnx"]


def export_onnx(directory: str | os.PathLike[str], step: bool = False) -> onnx.ModelProto:
    """The network of a model's directory (manifest.json and model.safetensors) as a graph of ONNX in single precision.

    It takes windows: frames ``[batch, context, height, width]`` from 0 to 1, and the states and actions of the manifest in
    their own units. With ``step``, a dense network takes one frame and the features of those before it instead. Raises
    :class:`UnsupportedModel`, a ``ValueError``, where the directory holds no such model.
    """
    model = ModelDirectory(Path(directory))
    try:
        return _graph(model, step)
    except KeyError as error:
        raise UnsupportedModel(f"the specification in {directory}/manifest.json has no field {error}") from error
    except (InferenceError, ValidationError) as error:
        message = f"the tensors in {directory}/model.safetensors do not have the shapes that manifest.json states"
        raise UnsupportedModel(f"{message}: {str(error).splitlines()[0]}") from error


def _graph(model: ModelDirectory, step: bool) -> onnx.ModelProto:
    network = _network(model)
    graph = Graph()
    if not step:
        network.add_window(graph)
    elif isinstance(network, DenseNetwork):
        network.add_step(graph)
    else:
        raise UnsupportedModel(
            f"{model.name} is a flow network, which has no step of a stream: it sees each window from its last frame, "
            "so nothing is left to keep but the frames; export it without --step"
        )
    return graph.model(model.name, {"foreframe.model": model.name, "foreframe.manifest.spec": json.dumps(model.spec)})


def _network(model: ModelDirectory) -> DenseNetwork | FlowNetwork | DepthNetwork:
    if model.architecture == "dense":
        return DenseNetwork(model)
    if model.architecture == "flow":
        return DepthNetwork(model) if model.spec["flow"].get("depth", False) else FlowNetwork(model)
    raise UnsupportedModel(f"{model.name} has the architecture {model.architecture!r}; dense and flow can be exported")
