"""Eight float32 at once, and numbers at bare addresses: for use inside the numba code of `brick_sums` and its like.

numba has no such type, and the compiler does not find vectors in loops of six or eight steps. On a processor without vectors of
eight it cuts these into smaller ones. Arrays are handed on as addresses, because numba counts references to arrays wherever one
function hands them to another, hundreds of times a point. Nothing here checks an address.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, register_model

from potserver.numerics import fastexp

LANES = 8
_F32, _I32 = ir.FloatType(), ir.IntType(32)
_VECTOR, _INTEGERS = ir.VectorType(_F32, LANES), ir.VectorType(_I32, LANES)
_CONTRACT = ("contract",)  # of a product and a sum: one instruction where the processor has it


class _Float32x8(types.Type):  # type: ignore[misc]  # numba has no types
    """Eight float32 in a register."""

    def __init__(self) -> None:
        super().__init__(name="Float32x8")


_float32x8 = _Float32x8()


@register_model(_Float32x8)
class _Float32x8Model(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _load(of: Any, kind: ir.Type, align: int, name: str) -> Any:
    """A function from an address, int64, to the value there."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(builder.inttoptr(args[0], kind.as_pointer()), align=align)
        return builder.sext(value, ir.IntType(64)) if of is types.int64 and kind.width < 64 else value

    def load(_context: Any, address: Any) -> Any:
        return of(types.int64), codegen

    return _named(load, name)


def _store(of: Any, kind: ir.Type, align: int, name: str) -> Any:
    """A function of an address, int64, and the value that is put there."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[1], builder.inttoptr(args[0], kind.as_pointer()), align=align)
        return context.get_dummy_value()

    def store(_context: Any, address: Any, value: Any) -> Any:
        return types.void(types.int64, of), codegen

    return _named(store, name)


def _named(typing: Callable[..., Any], name: str) -> Any:
    typing.__name__ = typing.__qualname__ = name  # numba's cache tells functions apart by name
    return intrinsic(typing)


load8 = _load(_float32x8, _VECTOR, 4, "load8")
load_f32 = _load(types.float32, _F32, 4, "load_f32")
load_f64 = _load(types.float64, ir.DoubleType(), 8, "load_f64")
load_i8 = _load(types.int64, ir.IntType(8), 1, "load_i8")  # this and the next three as an int64
load_i16 = _load(types.int64, ir.IntType(16), 2, "load_i16")
load_i32 = _load(types.int64, _I32, 4, "load_i32")
load_i64 = _load(types.int64, ir.IntType(64), 8, "load_i64")
store8 = _store(_float32x8, _VECTOR, 4, "store8")
store_i64 = _store(types.int64, ir.IntType(64), 8, "store_i64")


@intrinsic
def splat8(_context: Any, value: Any) -> Any:
    """A float32, eight times."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), args[0], ir.Constant(_I32, 0))
        return builder.shuffle_vector(
            one, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTEGERS, [0] * LANES)
        )

    return _float32x8(types.float32), codegen


@intrinsic
def times8(_context: Any, a: Any, b: Any) -> Any:
    """a * b."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(*args)

    return _float32x8(_float32x8, _float32x8), codegen


@intrinsic
def minus8(_context: Any, a: Any, b: Any) -> Any:
    """a - b."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fsub(*args)

    return _float32x8(_float32x8, _float32x8), codegen


@intrinsic
def fma8(_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(builder.fmul(args[0], args[1], flags=_CONTRACT), args[2], flags=_CONTRACT)

    return _float32x8(_float32x8, _float32x8, _float32x8), codegen


@intrinsic
def sum8(_context: Any, a: Any) -> Any:
    """The sum of the eight, halves first."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = args[0]
        for half in (4, 2, 1):
            narrow = ir.VectorType(_I32, half)
            low, high = (
                builder.shuffle_vector(vector, vector, ir.Constant(narrow, list(range(start, start + half))))
                for start in (0, half)
            )
            vector = builder.fadd(low, high)
        return builder.extract_element(vector, ir.Constant(_I32, 0))

    return types.float32(_float32x8), codegen


@intrinsic
def exp8(_context: Any, x: Any) -> Any:
    """exp(x) of eight numbers of at most 0: `fastexp.exp32`."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def all_of(value: Any) -> Any:
            return ir.Constant(_VECTOR, [float(value)] * LANES)

        def integers(value: int) -> Any:
            return ir.Constant(_INTEGERS, [value] * LANES)

        def fma(a: Any, b: Any, c: Any) -> Any:
            return builder.fadd(builder.fmul(a, b, flags=_CONTRACT), c, flags=_CONTRACT)

        is_there = builder.fcmp_ordered(">", args[0], all_of(fastexp.LOWEST))
        x = builder.select(is_there, args[0], all_of(fastexp.LOWEST))
        shifted = fma(x, all_of(fastexp.LOG2E), all_of(fastexp.MAGIC))
        whole = builder.fsub(shifted, all_of(fastexp.MAGIC))
        r = fma(whole, all_of(-fastexp.LN2_HIGH), x)
        r = fma(whole, all_of(-fastexp.LN2_LOW), r)
        p = all_of(fastexp.POLYNOMIAL[0])
        for coefficient in fastexp.POLYNOMIAL[1:]:
            p = fma(p, r, all_of(coefficient))
        y = builder.fadd(fma(builder.fmul(p, r), r, r), all_of(1.0))
        exponent = builder.add(
            builder.bitcast(shifted, _INTEGERS), integers(int(fastexp.BIAS) - int(fastexp.MAGIC_BITS))
        )
        scale = builder.bitcast(builder.shl(exponent, integers(int(fastexp.MANTISSA_BITS))), _VECTOR)
        return builder.select(is_there, builder.fmul(y, scale), all_of(0.0))

    return _float32x8(_float32x8), codegen
