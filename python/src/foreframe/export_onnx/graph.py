"""A graph of ONNX, written with NumPy's operators and functions.

A :class:`Tensor` is the result of a node. NumPy's arithmetic with tensors adds nodes to the graph; arithmetic with arrays alone
is done at once, so constants stay constants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import onnx
from numpy.typing import NDArray

#: Runtimes since 2022 know it.
OPSET, IR_VERSION = 17, 8
_LAST = np.iinfo(np.int64).max

#: What the functions of this package take and give: tensors and constants.
Value: TypeAlias = Any
Array: TypeAlias = NDArray[Any]

_OPERATORS: Mapping[np.ufunc, str] = {
    np.add: "Add",
    np.subtract: "Sub",
    np.multiply: "Mul",
    np.true_divide: "Div",
    np.matmul: "MatMul",
    np.negative: "Neg",
    np.absolute: "Abs",
    np.minimum: "Min",
    np.maximum: "Max",
    np.exp: "Exp",
    np.sqrt: "Sqrt",
    np.sin: "Sin",
    np.cos: "Cos",
    np.tan: "Tan",
    np.tanh: "Tanh",
    np.less: "Less",
    np.less_equal: "LessOrEqual",
    np.greater: "Greater",
    np.greater_equal: "GreaterOrEqual",
    np.bitwise_and: "And",
    np.bitwise_or: "Or",
    np.invert: "Not",
}


class Tensor(np.lib.mixins.NDArrayOperatorsMixin):
    """The result of a node, or an input of the graph."""

    def __init__(self, graph: Graph, name: str) -> None:
        self.graph, self.name = graph, name

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Value, **options: Any) -> Any:
        if method != "__call__" or options or ufunc not in _OPERATORS:
            return NotImplemented
        return self.graph.node(_OPERATORS[ufunc], *inputs)

    def __getitem__(self, index: int | slice | tuple[int | slice, ...]) -> Tensor:
        """A part along the first axes. An integer drops its axis."""
        starts, stops, steps, axes, dropped = [], [], [], [], []
        for axis, part in enumerate(index if isinstance(index, tuple) else (index,)):
            if isinstance(part, int):
                dropped.append(axis)
                part = slice(part, part + 1 or None)
            if part != slice(None):
                starts.append(part.start or 0)
                stops.append(_LAST if part.stop is None else part.stop)
                steps.append(part.step or 1)
                axes.append(axis)
        sliced = self.graph.node("Slice", self, *(np.array(numbers) for numbers in (starts, stops, axes, steps)))
        return self.graph.node("Squeeze", sliced, np.array(dropped)) if dropped else sliced

    def reshape(self, *shape: int) -> Tensor:
        return self.graph.node("Reshape", self, np.array(shape))


class Graph:
    """Nodes, inputs and outputs. Identical nodes are shared."""

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._known: dict[Any, Tensor] = {}
        self._constants: list[onnx.TensorProto] = []
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []

    def input(self, name: str, shape: Sequence[int | str], about: str) -> Tensor:
        """An input of the graph, float32."""
        self._inputs.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape, about))
        return Tensor(self, name)

    def output(self, name: str, value: Tensor, shape: Sequence[int | str], about: str) -> None:
        """An output of the graph, float32."""
        self._nodes.append(onnx.helper.make_node("Identity", [value.name], [name], name))
        self._outputs.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape, about))

    def node(self, operator: str, *operands: Value, **attributes: Any) -> Tensor:
        """The first result of an operator of ONNX. Operands that are arrays or numbers become constants."""
        names = [self._constant(x).name if not isinstance(x, Tensor) else x.name for x in operands]
        key = (operator, *names, repr(sorted(attributes.items())))
        if key not in self._known:
            name = f"{operator}_{len(self._nodes)}"
            self._nodes.append(onnx.helper.make_node(operator, names, [name], name, **attributes))
            self._known[key] = Tensor(self, name)
        return self._known[key]

    def _constant(self, value: Any) -> Tensor:
        array = np.asarray(value)
        # Whole numbers in an array are a shape, axes or indices. All other numbers are values.
        if array.dtype.kind == "i" and array.ndim:
            array = array.astype(np.int64)
        elif array.dtype.kind in "if":
            array = array.astype(np.float32)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._known:
            name = f"constant_{len(self._constants)}"
            self._constants.append(onnx.numpy_helper.from_array(array, name))
            self._known[key] = Tensor(self, name)
        return self._known[key]

    def model(self, name: str, about: Mapping[str, str]) -> onnx.ModelProto:
        """The checked model. ``about``: its metadata."""
        graph = onnx.helper.make_graph(self._nodes, name, self._inputs, self._outputs, self._constants)
        opset = onnx.helper.make_opsetid("", OPSET)
        model = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="foreframe")
        onnx.helper.set_model_props(model, dict(about))
        onnx.checker.check_model(model, full_check=True)
        return model


def concat(parts: Sequence[Value], axis: int = 1) -> Tensor:
    """Joins tensors and constants along an axis. A constant with one row is repeated for each row of the first tensor."""
    like = next(part for part in parts if isinstance(part, Tensor))
    whole = [part if isinstance(part, Tensor) else for_each_row(part, like) for part in parts]
    return whole[0] if len(whole) == 1 else like.graph.node("Concat", *whole, axis=axis)


def for_each_row(constant: Array, like: Tensor) -> Tensor:
    """A constant ``[1, …]`` for each row of a tensor: ``[rows, …]``."""
    rows = like.graph.node("Shape", like, start=0, end=1)
    shape = like.graph.node("Concat", rows, np.ones(constant.ndim - 1, np.int64), axis=0)
    return like.graph.node("Expand", constant, shape)


def repeated(x: Tensor, count: int, shape: Sequence[int]) -> Tensor:
    """Repeats each row of ``[rows, *shape]`` ``count`` times: ``[rows · count, *shape]``."""
    row = x.graph.node("Unsqueeze", x, np.array([1]))
    return x.graph.node("Expand", row, np.array([1, count, *(1 for _ in shape)])).reshape(-1, *shape)


def where(condition: Tensor, x: Value, y: Value) -> Tensor:
    return condition.graph.node("Where", condition, x, y)


def clip(x: Value, low: Value, high: Value) -> Value:
    return np.minimum(np.maximum(x, low), high)


def mean(x: Tensor, axes: Sequence[int]) -> Tensor:
    return x.graph.node("ReduceMean", x, axes=list(axes), keepdims=1)


def total(x: Tensor, axis: int) -> Tensor:
    return x.graph.node("ReduceSum", x, np.array([axis]), keepdims=1)
