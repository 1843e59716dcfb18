"""Vectors of eight numbers, which compiled code keeps in registers of the processor.

A kernel loads a vector from eight consecutive elements of an array, computes with ``+``, ``-``, ``*``, ``/`` and
``<=``, and stores the result. Each operation becomes the vector instructions of the processor. LLVM vectorizes a loop
only if its analysis succeeds, and it does not keep sums of eight columns in registers.

In interpreted kernels, a vector is a NumPy array. ``<=`` gives 1.0 or 0.0 in compiled code and a Boolean array in
interpreted code, so the result must be multiplied by 1.0.
"""

import operator
from functools import reduce
from typing import Any, Final

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core.datamodel import models
from numba.extending import lower_builtin, register_model, type_callable
from numpy.typing import NDArray

LANES: Final = 8
"""Number of elements of a vector."""

_INT, _DOUBLE = ir.IntType(64), ir.DoubleType()


class VectorType(types.Type):  # type: ignore[misc]
    """Type of a vector in Numba, for elements of the type float64 or int64."""

    def __init__(self, element: Any) -> None:
        self.element = element
        super().__init__(name=f"Vector({element})")


_FLOATS, _INTS = VectorType(types.float64), VectorType(types.int64)


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, vector: VectorType) -> None:
        super().__init__(manager, vector, ir.VectorType(manager.lookup(vector.element).get_value_type(), LANES))


def load_vector(array: NDArray[Any], start: int | np.uintp) -> NDArray[Any]:
    """Return eight consecutive elements of a one-dimensional array of float64 or int64."""
    return array[start : start + LANES].copy()


def load_column(array: NDArray[Any], start: int | np.uintp) -> NDArray[Any]:
    """Return every eighth element of an array, eight in total, which is a column of eight rows of eight elements."""
    return array[start : start + LANES * LANES : LANES].copy()


def store_vector(array: NDArray[Any], start: int | np.uintp, vector: NDArray[Any]) -> None:
    """Write a vector to eight consecutive elements of an array."""
    array[start : start + LANES] = vector


def prefetch(array: NDArray[Any], index: int | np.uintp) -> None:
    """Begin to load the cache line of an element into the cache."""


def broadcast(value: float) -> NDArray[np.float64]:
    """Return a vector of eight equal elements."""
    return np.full(LANES, value)


def sum_vector(vector: NDArray[np.float64]) -> float:
    """Return the sum of the elements of a vector of floats."""
    return float(vector.sum())


def to_floats(integers: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return a vector of integers as floats, each rounded to the nearest float."""
    return integers.astype(np.float64)


def to_integers(floats: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return a vector of whole numbers as integers."""
    return floats.astype(np.int64)


type_callable(load_vector)(lambda _context: lambda array, start: VectorType(array.dtype))
type_callable(load_column)(lambda _context: lambda array, start: VectorType(array.dtype))
type_callable(store_vector)(lambda _context: lambda array, start, vector: types.none)
type_callable(prefetch)(lambda _context: lambda array, index: types.none)
type_callable(broadcast)(lambda _context: lambda value: _FLOATS)
type_callable(sum_vector)(lambda _context: lambda vector: types.float64)
type_callable(to_floats)(lambda _context: lambda integers: _FLOATS)
type_callable(to_integers)(lambda _context: lambda floats: _INTS)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, start: Any, vector: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [start]), vector.as_pointer())


@lower_builtin(load_vector, types.Array, types.Integer)  # type: ignore[untyped-decorator]
def _load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    vector = context.get_value_type(signature.return_type)
    array, start = arguments
    loaded = builder.load(_pointer(context, builder, signature.args[0], array, start, vector))
    loaded.align = signature.args[0].dtype.bitwidth // 8
    return loaded


@lower_builtin(load_column, types.Array, types.Integer)  # type: ignore[untyped-decorator]
def _load_column(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    column = ir.Constant(context.get_value_type(signature.return_type), ir.Undefined)
    for i in range(LANES):
        index = builder.add(arguments[1], ir.Constant(arguments[1].type, i * LANES))
        column = builder.insert_element(column, builder.load(builder.gep(data, [index])), ir.Constant(_INT, i))
    return column


@lower_builtin(store_vector, types.Array, types.Integer, VectorType)  # type: ignore[untyped-decorator]
def _store(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array, start, vector = arguments
    builder.store(vector, _pointer(context, builder, signature.args[0], array, start, vector.type), align=8)
    return context.get_dummy_value()


@lower_builtin(to_floats, VectorType)  # type: ignore[untyped-decorator]
def _convert_to_floats(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Convert integers to floats. Only AVX-512 has an instruction for this on x86.

    For other x86 processors, the upper and the lower 32 bits become mantissas of two floats, whose sum is the result.
    """
    floats = ir.VectorType(_DOUBLE, LANES)
    if signature.args[0].element.bitwidth == 32:
        return builder.sitofp(arguments[0], floats)
    if not binding.get_process_triple().startswith("x86") or binding.get_host_cpu_features().get("avx512dq"):
        return builder.sitofp(arguments[0], floats)
    halves = ir.VectorType(ir.IntType(32), 2 * LANES)
    lower = builder.shuffle_vector(
        builder.bitcast(arguments[0], halves),
        ir.Constant(halves, [0x43300000] * (2 * LANES)),  # upper half of a float from 2⁵²
        ir.Constant(halves, [i if i % 2 == 0 else 2 * LANES for i in range(2 * LANES)]),
    )
    upper = builder.lshr(arguments[0], _constant(_INT, 32))
    upper = builder.bitcast(builder.xor(upper, _constant(_INT, (0x453 << 52) + (1 << 31))), floats)  # from 2⁸⁴
    upper = builder.fsub(upper, _constant(_DOUBLE, 2.0**84 + 2.0**63 + 2.0**52))
    return builder.fadd(upper, builder.bitcast(lower, floats))


@lower_builtin(prefetch, types.Array, types.Integer)  # type: ignore[untyped-decorator]
def _prefetch(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    address = builder.bitcast(builder.gep(data, [arguments[1]]), ir.IntType(8).as_pointer())
    integer = ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [address.type, integer, integer, integer])
    function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
    builder.call(function, [address, ir.Constant(integer, 0), ir.Constant(integer, 3), ir.Constant(integer, 1)])
    return context.get_dummy_value()


@lower_builtin(broadcast, types.Float)  # type: ignore[untyped-decorator]
def _repeat(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return _broadcast(context, builder, signature.return_type, signature.args[0], arguments[0])


@lower_builtin(sum_vector, VectorType)  # type: ignore[untyped-decorator]
def _sum(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    elements = [builder.extract_element(arguments[0], ir.Constant(_INT, i)) for i in range(LANES)]
    return reduce(builder.fadd, elements)


@lower_builtin(to_integers, VectorType)  # type: ignore[untyped-decorator]
def _convert_to_integers(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    return builder.fptosi(arguments[0], ir.VectorType(_INT, LANES))


def _constant(element: Any, value: float) -> Any:
    return ir.Constant(ir.VectorType(element, LANES), [value] * LANES)


def _broadcast(context: Any, builder: Any, vector: VectorType, kind: Any, value: Any) -> Any:
    """Return an operand as a vector. A scalar is repeated."""
    if isinstance(kind, VectorType):
        return value
    both = context.get_value_type(vector)
    value = context.cast(builder, value, kind, vector.element)
    first = builder.insert_element(ir.Constant(both, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def _register_operator(symbol: Any, instruction_of_floats: str, instruction_of_integers: str) -> None:
    @type_callable(symbol)  # type: ignore[untyped-decorator]
    def infer(_context: Any) -> Any:
        def typer(left: Any, right: Any) -> Any:
            vectors = [one for one in (left, right) if isinstance(one, VectorType)]
            return vectors[0] if vectors else None

        return typer

    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = signature.return_type
        left, right = (
            _broadcast(context, builder, vector, kind, value)
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        if symbol is operator.le:
            return builder.select(
                builder.fcmp_ordered("<=", left, right), _constant(_DOUBLE, 1.0), _constant(_DOUBLE, 0.0)
            )
        instruction = instruction_of_floats if vector == _FLOATS else instruction_of_integers
        return getattr(builder, instruction)(left, right)

    for kinds in ((VectorType, VectorType), (VectorType, types.Number), (types.Number, VectorType)):
        lower_builtin(symbol, *kinds)(lower)


_register_operator(operator.add, "fadd", "add")
_register_operator(operator.sub, "fsub", "sub")
_register_operator(operator.mul, "fmul", "mul")
_register_operator(operator.truediv, "fdiv", "")
_register_operator(operator.le, "", "")
