"""Elementary functions for vectorised loops; the last bit depends on the processor."""

import math
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from maasi_filter.arrays import FloatArray

# exp(x) = 2^k exp(r): adding MAGIC to x / log(2) leaves k in the low bits of the sum.
MAGIC = 6755399441055744.0
LOG2_E = 1.4426950408889634
LOG_2_HIGH = 6.93147180369123816490e-01
LOG_2_LOW = 1.90821492927058770002e-10
LEAST_EXPONENT = -708.0  # below this exp(x) is taken as 0


def _generate_wide_vectors(context: Any) -> Any:
    """Let loops of the calling kernel use the widest vectors; compilers default to half of them."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # The attributes' own `add` rejects attributes with a value.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


use_wide_vectors: Any = intrinsic(_generate_wide_vectors)


@njit(cache=True, error_model='numpy', fastmath={'contract'})
def arctan2(y: float, x: float) -> float:
    """Return the angle of (x, y) with an error of about one ulp (fdlibm's polynomial); 0 at 0."""
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
def exponential(x: float) -> float:
    """Return exp(x) for x up to 700 with an error of about one ulp; 0 below -708."""
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
    power = (np.float64(shifted).view(np.int64) + 1023) << 52
    scaled = value * np.int64(power).view(np.float64)
    return scaled if x >= LEAST_EXPONENT else 0.0


@njit(cache=True, error_model='numpy')
def normalised(offset, covariance):  # type: ignore[no-untyped-def]
    """Return x' C^-1 x and the log of the root of det C, by the Cholesky factor of C (d, d)."""
    d = len(offset)
    root = np.zeros((d, d))
    scaled = np.empty(d)
    total = 0.0
    log_root = 0.0
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
        log_root += math.log(root[i, i])
    return total, log_root


def squared_distance(offset: FloatArray, covariance: FloatArray) -> float:
    """Return the squared normalised distance x' C^-1 x, with the covariance C (d, d)."""
    return float(normalised(offset, covariance)[0])
