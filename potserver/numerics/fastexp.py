"""A float32 exponential that the compiler turns into SIMD code.

numba's `np.exp` calls a scalar function for each value (3 to 7 ns); this branch-free one takes about 0.4 ns. It reduces the
range by adding and subtracting 1.5 * 2^23, then takes a polynomial of degree 6; the largest relative error is 2e-7.

It must stay a function of its own with `contract` as its only fast-math flag. Under `reassoc` the compiler cancels the addition
and the subtraction, and results are wrong by up to 40 %, without a warning.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

# For inner loops around exp32, not for exp32 itself. Two rules keep their sums the same to the bit in every run:
# - They are inlined into the one function that is called from Python. As functions of their own they are compiled in several
#   copies that add in different orders, and whether the code was compiled or loaded from the cache decides which copy runs.
# - A loop that sums stores nothing. The compiler guards loops that store by a check of how far apart their arrays lie, and the
#   guarded and the unguarded loop add in different orders.
inner_loop = nb.njit(
    nogil=True,
    fastmath={"nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"},
    error_model="numpy",
    cache=True,
    forceinline=True,
)

_f = np.float32
LOG2E, MAGIC = _f(1.44269504088896), _f(12582912.0)
LN2_HIGH, LN2_LOW = _f(0.693359375), _f(-2.12194440e-4)
_P0, _P1, _P2 = _f(1.9875691500e-4), _f(1.3981999507e-3), _f(8.3334519073e-3)
_P3, _P4, _P5 = _f(4.1665795894e-2), _f(1.6666665459e-1), _f(5.0000001201e-1)
POLYNOMIAL = (_P0, _P1, _P2, _P3, _P4, _P5)
_ONE, _ZERO, LOWEST, _HIGHEST = _f(1), _f(0), _f(-87.0), _f(88.0)
BIAS, MANTISSA_BITS, MAGIC_BITS = np.int32(127), np.int32(23), np.int32(0x4B400000)


@intrinsic
def _float_bits(typing_context: Any, x: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), codegen


@intrinsic
def _bits_float(typing_context: Any, x: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


@nb.njit(fastmath={"contract"}, error_model="numpy", cache=True)
def exp32(x: np.float32) -> np.float32:
    """exp(x) for float32; 0 at and below -87, exp(88) above 88."""
    clipped = min(max(x, LOWEST), _HIGHEST)
    shifted = clipped * LOG2E + MAGIC
    exponent = _float_bits(shifted) - MAGIC_BITS
    whole = shifted - MAGIC
    r = clipped - whole * LN2_HIGH - whole * LN2_LOW
    p = _P0
    p = p * r + _P1
    p = p * r + _P2
    p = p * r + _P3
    p = p * r + _P4
    p = p * r + _P5
    y = p * r * r + r + _ONE
    y = y * _bits_float((exponent + BIAS) << MANTISSA_BITS)
    return y if x > LOWEST else _ZERO
