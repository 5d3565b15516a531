"""Elementary functions for kernels, in forms that loops over arrays turn into vector instructions.

Multiplications and additions may be fused, so that the last bit depends on the processor.
"""

from __future__ import annotations

import math

from numba import njit

# exp(x) = 2^k exp(r): adding MAGIC to x / log(2) leaves k in the low bits of the sum.
MAGIC = 6755399441055744.0
LOG2_E = 1.4426950408889634
LOG_2_HIGH = 6.93147180369123816490e-01
LOG_2_LOW = 1.90821492927058770002e-10
# Below this exp(x) is taken as 0.
LEAST_EXPONENT = -708.0


@njit(cache=True, error_model='numpy', fastmath={'contract'})
def arctan2(y: float, x: float) -> float:  # pragma: no cover - compiled
    """Return the angle of (x, y), to about one unit in the last place; 0 at the origin.

    Cephes' rational approximation.
    """
    ax = abs(x)
    ay = abs(y)
    small = min(ax, ay)
    large = max(ax, ay)
    # Choices instead of branches, so that loops over arrays become vector instructions.
    upper = small > 0.66 * large
    top = small - large if upper else small
    bottom = small + large if upper else large
    t = top / (bottom if bottom > 0.0 else 1.0)
    z = t * t
    top = -8.750608600031904122785e-1 * z - 1.615753718733365076637e1
    top = (top * z - 7.500855792314704667340e1) * z - 1.228866684490136173410e2
    top = top * z - 6.485021904942025371773e1
    bottom = (z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2
    bottom = (bottom * z + 4.328810604912902668951e2) * z + 4.853903996359136964868e2
    bottom = bottom * z + 1.945506571482613964425e2
    angle = (0.25 * math.pi if upper else 0.0) + (t + t * (z * top / bottom))
    angle = 0.5 * math.pi - angle if ay > ax else angle
    angle = math.pi - angle if x < 0.0 else angle
    return angle if y >= 0.0 else -angle


@njit(cache=True, error_model='numpy', fastmath={'contract'})
def exponentials(x, number, scratch, bits):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Replace the first `number` of `x`, none above 700, by exp(x), to a unit in the last place.

    `scratch` is as long as `x`, and `bits` is a view of it as int64. Below -708 the result is 0.
    """
    for i in range(number):
        exponent = max(x[i], LEAST_EXPONENT)
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
        # An exponent of -1023 has the bits of 0.
        scratch[i] = shifted if x[i] >= LEAST_EXPONENT else MAGIC - 1023.0
        x[i] = value
    for i in range(number):
        bits[i] = (bits[i] + 1023) << 52
    for i in range(number):
        x[i] *= scratch[i]
