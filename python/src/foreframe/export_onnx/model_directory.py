"""A model's directory: manifest.json and model.safetensors."""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DTYPES: dict[str, type[np.floating[Any]]] = {"F16": np.float16, "F32": np.float32}


class UnsupportedModel(ValueError):
    """A directory that holds no model, or one that cannot be exported."""


class Weights(dict[str, NDArray[np.float32]]):
    """The tensors of a model, by name."""

    def __missing__(self, name: str) -> NDArray[np.float32]:
        raise UnsupportedModel(f"model.safetensors has no tensor {name!r}, which the network of manifest.json needs")


class ModelDirectory:
    """The manifest and the weights of a model."""

    def __init__(self, directory: Path) -> None:
        try:
            self.manifest: dict[str, Any] = json.loads((directory / "manifest.json").read_text())
            data = (directory / "model.safetensors").read_bytes()
        except (OSError, ValueError) as error:
            raise UnsupportedModel(f"{directory} is not a directory with manifest.json and model.safetensors: {error}") from error
        if "spec" not in self.manifest:
            raise UnsupportedModel(f"{directory / 'manifest.json'} has no `spec`; it is not a manifest of Foreframe")
        if hashlib.sha256(data).hexdigest() != self.manifest.get("weights_sha256"):
            raise UnsupportedModel(f"{directory / 'model.safetensors'} is not the file of which manifest.json has the SHA-256")
        self.spec: dict[str, Any] = self.manifest["spec"]
        self.weights = _tensors(data)

    @property
    def name(self) -> str:
        return str(self.manifest["name"])

    @property
    def architecture(self) -> str:
        return str(self.spec.get("architecture", "dense"))


def _tensors(data: bytes) -> Weights:
    (length,) = struct.unpack("<Q", data[:8])
    weights = Weights()
    for name, entry in json.loads(data[8 : 8 + length]).items():
        if name == "__metadata__":
            continue
        if entry["dtype"] not in _DTYPES:
            raise UnsupportedModel(f"tensor {name!r} is {entry['dtype']}; F16 and F32 can be exported")
        first, last = (8 + length + offset for offset in entry["data_offsets"])
        weights[name] = np.frombuffer(data[first:last], _DTYPES[entry["dtype"]]).reshape(entry["shape"]).astype(np.float32)
    return weights
