"""Elementary functions for kernels, in forms that loops over arrays turn into vector instructions.

Multiplications and additions may be fused, so that the last bit depends on the processor.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

# exp(x) = 2^k exp(r): adding MAGIC to x / log(2) leaves k in the low bits of the sum.
MAGIC = 6755399441055744.0
LOG2_E = 1.4426950408889634
LOG_2_HIGH = 6.93147180369123816490e-01
LOG_2_LOW = 1.90821492927058770002e-10
# pi / 2 in three parts, the first two with few digits.
HALF_PI_HIGH = 1.57079632673412561417e00
HALF_PI_MIDDLE = 6.07710050630396597660e-11
HALF_PI_LOW = 2.02226624879595063154e-21
# Below this exp(x) is taken as 0.
LEAST_EXPONENT = -708.0


def _generate_bits_of(context: Any, x: Any) -> Any:
    """Return the 64 bits of a float as an integer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(types.int64))

    return types.int64(types.float64), generate


_bits_of: Any = intrinsic(_generate_bits_of)


def _generate_float_of(context: Any, bits: Any) -> Any:
    """Return the float that has these 64 bits."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(types.float64))

    return types.float64(types.int64), generate


_float_of: Any = intrinsic(_generate_float_of)


def _generate_lesser(context: Any, x: Any, y: Any) -> Any:
    """Return the smaller of two numbers, in a form that makes a running minimum vectors."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        flags = ['nnan', 'nsz']
        first, second = arguments
        smaller = builder.fcmp_ordered('<', first, second, flags=flags)
        return builder.select(smaller, first, second, flags=flags)

    return types.float64(types.float64, types.float64), generate


lesser: Any = intrinsic(_generate_lesser)


def _generate_wide_vectors(context: Any) -> Any:
    """Have the loops of the kernel that calls this use the widest vectors there are.

    Compilers keep to half of what many processors have; kernels that compute more than they load
    are faster with all of it.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # The set's own `add` knows only attributes without a value.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


use_wide_vectors: Any = intrinsic(_generate_wide_vectors)


@njit(cache=True, error_model='numpy', fastmath={'contract'})
def arctan2(y: float, x: float) -> float:
    """Return the angle of (x, y), to about one unit in the last place; 0 at the origin.

    fdlibm's polynomial, with one division.
    """
    ax = abs(x)
    ay = abs(y)
    small = min(ax, ay)
    large = max(ax, ay)
    # Choices instead of branches, so that loops over arrays become vector instructions.
    upper = small > 0.42 * large
    top = small - large if upper else small
    bottom = small + large if upper else large
    t = top / (bottom if bottom > 0.0 else 1.0)
    z = t * t
    value = 1.62858201153657823623e-02
    value = value * z - 3.65315727442169155270e-02
    value = value * z + 4.97687799461593236017e-02
    value = value * z - 5.83357013379057348645e-02
    value = value * z + 6.66107313738753120669e-02
    value = value * z - 7.69187620504482999495e-02
    value = value * z + 9.09088713343650656196e-02
    value = value * z - 1.11111104054623557880e-01
    value = value * z + 1.42857142725034663711e-01
    value = value * z - 1.99999999998764832476e-01
    value = value * z + 3.33333333333329318027e-01
    angle = (0.25 * math.pi if upper else 0.0) + (t - t * (z * value))
    angle = 0.5 * math.pi - angle if ay > ax else angle
    angle = math.pi - angle if x < 0.0 else angle
    return angle if y >= 0.0 else -angle


@njit(cache=True, error_model='numpy', fastmath={'contract'})
def sines(x, number, sine, cosine):  # type: ignore[no-untyped-def]
    """Fill sine and cosine of the first `number` of `x`, of some thousand radians at most.

    To about one unit in the last place of 1; fdlibm's polynomials.
    """
    use_wide_vectors()
    for i in range(number):
        k = (x[i] * (2.0 / math.pi) + MAGIC) - MAGIC
        r = ((x[i] - k * HALF_PI_HIGH) - k * HALF_PI_MIDDLE) - k * HALF_PI_LOW
        z = r * r
        s = 1.58969099521155010221e-10
        s = s * z - 2.50507602534068634195e-08
        s = s * z + 2.75573137070700676789e-06
        s = s * z - 1.98412698298579493134e-04
        s = s * z + 8.33333333332248946124e-03
        s = s * z - 1.66666666666666324348e-01
        s = r + r * (z * s)
        c = -1.13596475577881948265e-11
        c = c * z + 2.08757232129817482790e-09
        c = c * z - 2.75573143513906633035e-07
        c = c * z + 2.48015872894767294178e-05
        c = c * z - 1.38888888888741095749e-03
        c = c * z + 4.16666666666666019037e-02
        c = 1.0 - 0.5 * z + z * z * c
        # The quarter of the circle, -2 to 2.
        quarter = k - 4.0 * ((k * 0.25 + MAGIC) - MAGIC)
        turned = abs(quarter) == 1.0
        a = c if turned else s
        b = s if turned else c
        sine[i] = -a if quarter == -1.0 or abs(quarter) == 2.0 else a
        cosine[i] = -b if quarter == 1.0 or abs(quarter) == 2.0 else b


@njit(cache=True, error_model='numpy', fastmath={'contract'})
def exponential(x: float) -> float:
    """Return exp(x), x not above 700, to a unit in the last place; 0 below -708."""
    exponent = max(x, LEAST_EXPONENT)
    shifted = exponent * LOG2_E + MAGIC
    k = shifted - MAGIC
    r = (exponent - k * LOG_2_HIGH) - k * LOG_2_LOW
    value = 1.0 / 479001600.0
    value = value * r + 1.0 / 39916800.0
    value = value * r + 1.0 / 3628800.0
    value = value * r + 1.0 / 362880.0
    value = value * r + 1.0 / 40320.0
    value = value * r + 1.0 / 5040.0
    value = value * r + 1.0 / 720.0
    value = value * r + 1.0 / 120.0
    value = value * r + 1.0 / 24.0
    value = value * r + 1.0 / 6.0
    value = value * r + 0.5
    value = value * r + 1.0
    value = value * r + 1.0
    scaled = value * _float_of((_bits_of(shifted) + 1023) << 52)
    return scaled if x >= LEAST_EXPONENT else 0.0


@njit(cache=True, error_model='numpy')
def squared_distance(offset, covariance):  # type: ignore[no-untyped-def]
    """Return the squared normalised distance x' C^-1 x, by the Cholesky factor of C (d, d)."""
    d = len(offset)
    root = np.zeros((d, d))
    scaled = np.empty(d)
    total = 0.0
    for i in range(d):
        rest = offset[i]
        for j in range(i + 1):
            value = covariance[i, j]
            for k in range(j):
                value -= root[i, k] * root[j, k]
            if i == j:
                root[i, i] = math.sqrt(max(value, 1e-300))
            else:
                root[i, j] = value / root[j, j]
                rest -= root[i, j] * scaled[j]
        scaled[i] = rest / root[i, i]
        total += scaled[i] * scaled[i]
    return total
