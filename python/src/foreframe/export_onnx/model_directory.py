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

_FIELDS: dict[str, type] = {
    "frame_width_px": int,
    "frame_height_px": int,
    "preprocess": dict,
    "context": int,
    "horizon": int,
    "conditioning": str,
    "actions": list,
    "states": list,
}
_FIELDS_OF: dict[str, dict[str, type]] = {"dense": {"features": int, "hidden": int}, "flow": {"flow": dict}}


class UnsupportedModel(ValueError):
    """A directory that holds no model, or one that cannot be exported."""


class Weights(dict[str, NDArray[np.float32]]):
    """The tensors of a model, by name."""

    def __missing__(self, name: str) -> NDArray[np.float32]:
        raise UnsupportedModel(f"model.safetensors has no tensor {name!r}, which the network of manifest.json needs")


class ModelDirectory:
    """The manifest and the weights of a model."""

    def __init__(self, directory: Path) -> None:
        manifest, weights = directory / "manifest.json", directory / "model.safetensors"
        try:
            text, data = manifest.read_bytes(), weights.read_bytes()
        except OSError as error:
            raise UnsupportedModel(f"{directory} is not a directory with manifest.json and model.safetensors: {error}") from error
        try:
            self.manifest: dict[str, Any] = json.loads(text)
        except ValueError as error:
            raise UnsupportedModel(f"{manifest} is not JSON: {error}") from error
        self.spec: dict[str, Any] = _checked_spec(self.manifest, manifest)
        expected = self.manifest.get("weights_sha256")
        if hashlib.sha256(data).hexdigest() != expected:
            raise UnsupportedModel(f"{weights} does not have the SHA-256 of `weights_sha256` in manifest.json, {expected}")
        self.weights = _tensors(data)

    @property
    def name(self) -> str:
        return str(self.manifest["name"])

    @property
    def architecture(self) -> str:
        return str(self.spec.get("architecture", "dense"))


def _checked_spec(manifest: Any, path: Path) -> dict[str, Any]:
    """The specification, with the fields that every network needs."""
    spec = manifest.get("spec") if isinstance(manifest, dict) else None
    if not isinstance(spec, dict) or "name" not in manifest:
        raise UnsupportedModel(f"{path} has no `spec` or no `name`; it is not a manifest of Foreframe")
    fields = _FIELDS | _FIELDS_OF.get(str(spec.get("architecture", "dense")), {})
    for field, kind in fields.items():
        if not isinstance(spec.get(field), kind):
            raise UnsupportedModel(f"{path}: spec.{field} is {spec.get(field)!r}; it must be of the type {kind.__name__}")
    return spec


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
