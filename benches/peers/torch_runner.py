"""A graph of ONNX by PyTorch's own operators, as eager PyTorch computes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import torch
from torch.nn import functional


def _whole(x: torch.Tensor) -> list[int]:
    return [int(number) for number in x]


def _slice(x: torch.Tensor, starts: list[int], stops: list[int], axes: list[int], steps: list[int]) -> torch.Tensor:
    index = [slice(None)] * x.ndim
    for start, stop, axis, step in zip(starts, stops, axes, steps):
        index[axis] = slice(start, min(stop, x.shape[axis]), step)
    return x[tuple(index)]


def _conv(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None = None, **options: Any) -> torch.Tensor:
    pads = options.get("pads", [0, 0])
    return functional.conv2d(
        x, weight, bias, stride=options.get("strides", 1), padding=pads[:2], dilation=options.get("dilations", 1)
    )


def _conv_transpose(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, **options: Any) -> torch.Tensor:
    return functional.conv_transpose2d(
        x, weight, bias, stride=options["strides"], padding=options["pads"][:2], output_padding=options["output_padding"]
    )


def _space_to_depth(x: torch.Tensor, blocksize: int) -> torch.Tensor:
    rows, channels, height, width = x.shape
    blocks = x.reshape(rows, channels, height // blocksize, blocksize, width // blocksize, blocksize)
    return blocks.permute(0, 3, 5, 1, 2, 4).reshape(rows, -1, height // blocksize, width // blocksize)


def _depth_to_space(x: torch.Tensor, blocksize: int) -> torch.Tensor:
    rows, channels, height, width = x.shape
    groups = x.reshape(rows, blocksize, blocksize, channels // blocksize**2, height, width)
    return groups.permute(0, 3, 4, 1, 5, 2).reshape(rows, -1, height * blocksize, width * blocksize)


def _pad(x: torch.Tensor, pads: list[int], mode: str = "constant") -> torch.Tensor:
    left, right, top, bottom = pads[3], pads[7], pads[2], pads[6]
    return functional.pad(x, (left, right, top, bottom), mode="replicate" if mode == "edge" else mode)


def _grid_sample(x: torch.Tensor, grid: torch.Tensor, mode: str, padding_mode: str, align_corners: int) -> torch.Tensor:
    return functional.grid_sample(x, grid, mode=mode, padding_mode=padding_mode, align_corners=bool(align_corners))


def _expand(x: torch.Tensor, shape: list[int]) -> torch.Tensor:
    return x.expand(*np.broadcast_shapes(tuple(x.shape), tuple(shape)))


#: The operands that are shapes and places, by operator: lists of whole numbers.
_NUMBERS = {"Slice": (1, 2, 3, 4)} | dict.fromkeys(["Squeeze", "Unsqueeze", "Reshape", "Expand", "Pad", "ReduceSum"], (1,))

_OPERATORS: dict[str, Callable[..., Any]] = {
    "Add": torch.add, "Sub": torch.sub, "Mul": torch.mul, "Div": torch.div, "MatMul": torch.matmul, "Neg": torch.neg,
    "Abs": torch.abs, "Min": torch.minimum, "Max": torch.maximum, "Exp": torch.exp, "Sqrt": torch.sqrt, "Sin": torch.sin,
    "Cos": torch.cos, "Tan": torch.tan, "Tanh": torch.tanh, "Sigmoid": torch.sigmoid, "Less": torch.lt,
    "LessOrEqual": torch.le, "Greater": torch.gt, "GreaterOrEqual": torch.ge, "And": torch.logical_and,
    "Or": torch.logical_or, "Not": torch.logical_not, "Where": torch.where, "Identity": lambda x: x,
    "Slice": _slice, "Squeeze": lambda x, axes: x.squeeze(tuple(axes)), "Unsqueeze": lambda x, axes: x.unsqueeze(axes[0]),
    "Reshape": lambda x, shape: x.reshape(shape), "Expand": _expand, "Concat": lambda *parts, axis: torch.cat(parts, axis),
    "Shape": lambda x, start, end: list(x.shape[start:end]), "Gather": lambda x, places, axis: x.index_select(axis, places),
    "Transpose": lambda x, perm: x.permute(perm),
    "ReduceMean": lambda x, axes, keepdims: x.mean(axes, keepdim=bool(keepdims)),
    "ReduceSum": lambda x, axes, keepdims: x.sum(axes, keepdim=bool(keepdims)),
    "Softmax": torch.softmax, "Conv": _conv, "ConvTranspose": _conv_transpose, "Pad": _pad, "GridSample": _grid_sample,
    "AveragePool": lambda x, kernel_shape, strides: functional.avg_pool2d(x, kernel_shape, strides),
    "SpaceToDepth": _space_to_depth, "DepthToSpace": _depth_to_space,
}  # fmt: skip


def _joins_shapes(node: onnx.NodeProto) -> bool:
    return node.input[0].startswith("Shape")


class TorchModel:
    """Runs a model; inputs by name, outputs in their order."""

    def __init__(self, model: onnx.ModelProto) -> None:
        graph = model.graph
        self.outputs = [output.name for output in graph.output]
        self.constants = {one.name: torch.from_numpy(onnx.numpy_helper.to_array(one).copy()) for one in graph.initializer}
        self.steps = []
        for node in graph.node:
            options = {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute}
            options = {name: value.decode() if isinstance(value, bytes) else value for name, value in options.items()}
            if node.op_type == "Softmax":
                options["dim"] = options.pop("axis")
            if node.op_type == "Concat" and _joins_shapes(node):
                self.steps.append((lambda rows, ones, axis: [*rows, *ones], list(node.input), options, node.output[0]))
                self.constants[node.input[1]] = _whole(self.constants[node.input[1]])
                continue
            for place in _NUMBERS.get(node.op_type, ()):
                name = node.input[place]
                if isinstance(self.constants.get(name), torch.Tensor):
                    self.constants[name] = _whole(self.constants[name])
            self.steps.append((_OPERATORS[node.op_type], list(node.input), options, node.output[0]))

    @torch.no_grad()
    def __call__(self, inputs: dict[str, torch.Tensor]) -> list[torch.Tensor]:
        values: dict[str, Any] = {**self.constants, **inputs}
        for operator, names, options, name in self.steps:
            values[name] = operator(*[values[given] for given in names], **options)
        return [values[name] for name in self.outputs]
