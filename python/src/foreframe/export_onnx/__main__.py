"""``python -m foreframe.export_onnx``: writes a model as ONNX."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

try:
    from . import UnsupportedModel, export_onnx
except ModuleNotFoundError as error:
    sys.exit(f"error: {error}; install the package with its extra, foreframe[onnx]")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m foreframe.export_onnx", description="Writes a model as ONNX.")
    parser.add_argument("model", type=Path, help="directory with manifest.json and model.safetensors")
    parser.add_argument("out", type=Path, help="the file to write")
    parser.add_argument("--step", action="store_true", help="a step of a stream instead of a window; dense networks only")
    arguments = parser.parse_args()
    try:
        model = export_onnx(arguments.model, step=arguments.step)
        arguments.out.write_bytes(model.SerializeToString())
    except (UnsupportedModel, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for what, values in (("takes", model.graph.input), ("gives", model.graph.output)):
        for value in values:
            dimensions = value.type.tensor_type.shape.dim
            shape = ", ".join(dimension.dim_param or str(dimension.dim_value) for dimension in dimensions)
            print(f"{what} {value.name} [{shape}]: {value.doc_string}")
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
