"""What computes: Foreframe's benches as programs, onnxruntime and PyTorch as calls."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray

Inputs = dict[str, NDArray[np.float32]]
Call = Callable[[], object]

LEAST_S = 0.4
_SIDE = 2048
_UNIT_MS = {"ns": 1e-6, "µs": 1e-3, "ms": 1.0, "s": 1e3}


class Foreframe:
    """The built benches `model` and `flow`. They run on this process's core."""

    def __init__(self, programs: Path, root: Path) -> None:
        self.model, self.flow, self.root = _newest(programs, "model"), _newest(programs, "flow"), root

    def round(self) -> dict[str, float]:
        """Milliseconds by line."""
        found: dict[str, float] = {}
        for line in self._run(self.flow, "1").splitlines():
            if match := re.match(r"(\S+): window (\S+) ms, step of a stream \S+ ms, 8 windows (\S+) ms", line):
                found[f"{match[1]} window"], found[f"{match[1]} 8 windows"] = float(match[2]), float(match[3])
        options = ["--bench", "--noplot", "--warm-up-time", "0.5", "--measurement-time", "1", "--sample-size", "10"]
        printed = self._run(self.model, *options, "prediction|step of a stream")
        for line in re.finditer(r"^(.*(?:windows|a stream))\s+time:\s+\[\S+ \S+ (\S+) (\S+) ", printed, re.MULTILINE):
            found[line[1]] = float(line[2]) * _UNIT_MS[line[3]]
        return found

    def _run(self, program: Path, *arguments: str) -> str:
        with tempfile.TemporaryDirectory() as results:
            environment = os.environ | {"CRITERION_HOME": results}
            done = subprocess.run(
                [program, *arguments], cwd=self.root, env=environment, capture_output=True, text=True, check=True
            )
        return done.stdout


def _newest(programs: Path, name: str) -> Path:
    found = [path for path in programs.glob(f"{name}-*") if path.suffix == "" and os.access(path, os.X_OK)]
    if not found:
        raise SystemExit(f"{programs} has no bench `{name}`; build it: cargo bench --bench model --bench flow --no-run")
    return max(found, key=lambda path: path.stat().st_mtime)


def onnxruntime_runner(model: onnx.ModelProto, inputs: Inputs) -> Call:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return lambda: session.run(None, inputs)


def torch_runner() -> Callable[[onnx.ModelProto, Inputs], Call] | None:
    """PyTorch's operators one after the other; None if it is not installed."""
    try:
        import torch
    except ImportError:
        return None
    from torch_runner import TorchModel

    torch.set_num_threads(1)

    def runner(model: onnx.ModelProto, inputs: Inputs) -> Call:
        network, given = TorchModel(model), {name: torch.from_numpy(values) for name, values in inputs.items()}
        return lambda: network(given)

    return runner


def difference(outputs: object, others: object) -> float:
    """The largest difference of the first outputs of two runners."""
    first, other = (np.asarray(given[0]) for given in (outputs, others))  # type: ignore[index]
    return float(np.abs(first - other).max())


def products() -> dict[str, Call]:
    """A product of two large matrices in single precision, by each library."""
    a, b = np.random.default_rng(1).random((2, _SIDE, _SIDE)).astype(np.float32)
    one = onnx.helper.make_tensor_value_info("a", onnx.TensorProto.FLOAT, [_SIDE, _SIDE])
    two = onnx.helper.make_tensor_value_info("b", onnx.TensorProto.FLOAT, [_SIDE, _SIDE])
    out = onnx.helper.make_tensor_value_info("c", onnx.TensorProto.FLOAT, [_SIDE, _SIDE])
    graph = onnx.helper.make_graph([onnx.helper.make_node("MatMul", ["a", "b"], ["c"])], "product", [one, two], [out])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    return {"NumPy": lambda: a @ b, "onnxruntime": onnxruntime_runner(model, {"a": a, "b": b})}


def product_gflops(product: Call) -> float:
    return 2 * _SIDE**3 / milliseconds(product) / 1e6


def milliseconds(call: Call) -> float:
    """Mean time of a call, over at least 0.4 s."""
    call()
    started, count = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - started) < LEAST_S:
        call()
        count += 1
    return elapsed / count * 1e3
