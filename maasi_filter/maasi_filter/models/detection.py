"""Probability of detection pi(x, q), as kernels with the same parameters for all kinds."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types
from numba.core import cgutils
from numba.core.dispatcher import Dispatcher
from numba.extending import intrinsic
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.vector_math import exponential
from maasi_filter.models.pose import Pose

EXPONENTIAL, GAUSSIAN, BOX, CUSTOM = 0, 1, 2, 3
PARAMETERS = 9
# Further parameters of CUSTOM, after those of the radial models: number and address
# of the function, address of its values, and how many there are.
REACH, NUMBER, FUNCTION, VALUES, LENGTH = 4, 5, 6, 7, 8

# Latest entries from NUMBER on of each function, by number.
_known: dict[float, FloatArray] = {}


@intrinsic
def _call(typing_context, function, values, length, forward, left, up):  # type: ignore[no-untyped-def]
    """Call the function at an address, with the values at another, for an offset."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        integer, number = (context.get_value_type(kind) for kind in (types.int64, types.float64))
        several = number.as_pointer()
        kind = cgutils.ir.FunctionType(number, [number] * 3 + [several, integer])
        called = builder.inttoptr(arguments[0], kind.as_pointer())
        return builder.call(
            called, [*arguments[3:], builder.inttoptr(arguments[1], several), arguments[2]]
        )

    return types.float64(*[types.int64] * 3, *[types.float64] * 3), generate


def register(function: Callable[..., float], values: FloatArray) -> FloatArray:
    """Return the entries from NUMBER on for a function and its values, which give its number."""
    entries = _entries(function, np.asarray(values, dtype=float).tobytes())
    _known[entries[0]] = entries
    return entries


# The caches keep alive what kernels read by address.
@cache
def _entries(function: Callable[..., float], content: bytes) -> FloatArray:
    name = f'{function.__module__}:{function.__qualname__}'
    digest = hashlib.sha256(name.encode() + b'\0' + content).digest()
    values = np.frombuffer(content)
    # Floats are exact up to 2^53.
    number = int.from_bytes(digest[:6], 'little')
    return np.array([number, _compiled(function).address, values.ctypes.data, len(values)], float)


@cache
def _compiled(function: Callable[..., float]) -> Any:
    inner = function if isinstance(function, Dispatcher) else njit(error_model='numpy')(function)

    @cfunc('float64(float64, float64, float64, CPointer(float64), int64)')
    def call(forward, left, up, values, size):  # type: ignore[no-untyped-def]  # pragma: no cover
        return inner(forward, left, up, carray(values, (size,)))

    return call


def renew_addresses(kinds: FloatArray, parameters: FloatArray) -> None:
    """Replace the addresses in saved parameters (n, PARAMETERS) by those of this process."""
    for row in np.flatnonzero(kinds == CUSTOM).tolist():
        if parameters[row, NUMBER] not in _known:
            raise ValueError(
                'it was saved with a detection model of a plugin, which no sensor of this process '
                'has: make the sensors, with the same settings, before it is loaded'
            )
        parameters[row, NUMBER:] = _known[parameters[row, NUMBER]]


@njit(cache=True, error_model='numpy')
def detection_probability_at(kind, parameters, dx, dy, dz, cos_yaw, sin_yaw):  # type: ignore[no-untyped-def]
    """Return pi for a target at offset (dx, dy, dz) [m, map axes] from the sensor.

    `kind` is EXPONENTIAL (000, eq. (3), (4)), GAUSSIAN (003, section 2.2), BOX (000, eq. (25) and
    (34)), or CUSTOM, a plugin's function; `parameters` come from the model's `kernel()`.
    """
    x, y = dx, dy
    if kind == CUSTOM or (kind == BOX and parameters[8] > 0.5):
        x = cos_yaw * dx + sin_yaw * dy
        y = cos_yaw * dy - sin_yaw * dx
    if kind == CUSTOM:
        if dx * dx + dy * dy + dz * dz > parameters[REACH] * parameters[REACH]:
            return 0.0
        address, values = np.int64(parameters[FUNCTION]), np.int64(parameters[VALUES])
        length = np.int64(parameters[LENGTH])
        value = parameters[0] * _call(address, values, length, x, y, dz)  # type: ignore[call-arg]
        # Also false for NaN.
        return min(value, 1.0) if value > 0.0 else 0.0
    if kind == BOX:
        inside = min(x - parameters[1], parameters[4] - x)
        inside = min(inside, min(y - parameters[2], parameters[5] - y))
        inside = min(inside, min(dz - parameters[3], parameters[6] - dz))
        edge = parameters[7]
        if edge > 0.0:
            return parameters[0] * min(max(0.5 * (1.0 + inside / edge), 0.0), 1.0)
        return parameters[0] if inside >= 0.0 else 0.0
    square = (dx * parameters[1]) ** 2 + (dy * parameters[2]) ** 2 + (dz * parameters[3]) ** 2
    if kind == GAUSSIAN:
        return parameters[0] * math.exp(-0.5 * square)
    return parameters[0] * math.exp(-0.5 * math.sqrt(square))


@njit(cache=True, error_model='numpy')
def fill_probabilities(kind, parameters, x, y, z, cos_yaw, sin_yaw, out):  # type: ignore[no-untyped-def]
    """Fill pi (n,) for the first n offsets (x, y, z) [m, map axes] from the sensor."""
    if kind >= BOX:
        for i in range(len(out)):
            out[i] = detection_probability_at(kind, parameters, x[i], y[i], z[i], cos_yaw, sin_yaw)
        return
    gain, p, q, r = parameters[0], parameters[1], parameters[2], parameters[3]
    gaussian = kind == GAUSSIAN
    for i in range(len(out)):
        u = x[i] * p
        v = y[i] * q
        w = z[i] * r
        square = u * u + v * v + w * w
        out[i] = gain * exponential(-0.5 * (square if gaussian else math.sqrt(square)))


class DetectionModel:
    """Probability of detection of a target."""

    _kind: int

    def __init__(self, probability: float) -> None:
        if not (math.isfinite(probability) and 0.0 <= probability <= 1.0):
            raise ValueError(f'probability: got {probability}, allowed are numbers in [0, 1]')
        self.gain = float(probability)
        self._parameters = np.zeros(PARAMETERS)
        self._parameters[0] = self.gain

    def kernel(self) -> tuple[int, FloatArray]:
        """Return (kind, parameters) for `detection_probability_at`."""
        return self._kind, self._parameters

    def probability(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return pi(x, q) in [0, 1], (n,), for targets at positions (n, d) [m, map].

        In 2D the height of the sensor is ignored.
        """
        array = np.asarray(positions, dtype=float)
        if array.ndim != 2 or array.shape[1] not in (2, 3):
            raise ValueError(f'positions: got shape {array.shape}, allowed are (n, 2) and (n, 3)')
        number, d = array.shape
        offset, out = np.zeros((3, number)), np.empty(number)
        np.subtract(array.T, pose.position[:d, None], out=offset[:d])
        turn = math.cos(pose.yaw), math.sin(pose.yaw)
        fill_probabilities(*self.kernel(), *offset, *turn, out)  # type: ignore[call-arg]
        return out


class _RadialDetection(DetectionModel):
    def __init__(self, probability: float, size: Sequence[float]) -> None:
        self.size = np.array(size, dtype=float)
        if self.size.shape not in ((2,), (3,)) or not (self.size > 0.0).all():
            raise ValueError(f'size: got {list(size)}, allowed are 2 or 3 positive numbers')
        super().__init__(probability)
        self._parameters[1 : 1 + len(self.size)] = 1.0 / self.size


class ExponentialDetection(_RadialDetection):
    """pi = G exp(-|zeta| / 2), zeta the distance divided by F on each axis (000, eq. (3), (4)).

    Parameters
    ----------
    probability : float
        G, in [0, 1].
    size : sequence of 2 or 3 floats
        F on each map axis, metres. With two numbers the height is ignored.
    """

    _kind = EXPONENTIAL


class GaussianDetection(_RadialDetection):
    """pi = G exp(-|zeta|^2 / 2) (003, section 2.2); parameters as `ExponentialDetection`."""

    _kind = GAUSSIAN


class BoxDetection(DetectionModel):
    """pi = G inside a box around the sensor and 0 outside (000, eq. (25) and (34)).

    Parameters
    ----------
    lower, upper : sequences of 2 or 3 floats
        Corners of the box relative to the sensor, metres. With two numbers the height is ignored.
    probability : float
        G inside; 1 in the papers.
    frame : {'robot', 'world'}
        Whether the box turns with the robot's heading or stays aligned with the map.
    edge : float
        Half width of a linear ramp across the box's faces, metres; 0, as in the papers: a step.
    """

    _kind = BOX

    def __init__(
        self,
        lower: Sequence[float],
        upper: Sequence[float],
        probability: float = 1.0,
        frame: str = 'robot',
        edge: float = 0.0,
    ) -> None:
        low, high = self.lower, self.upper = np.array(lower, float), np.array(upper, float)
        if low.shape not in ((2,), (3,)) or low.shape != high.shape or not (low < high).all():
            raise ValueError(
                f'lower, upper: got {list(lower)}, {list(upper)}, allowed are 2 or 3 numbers '
                'each, with lower below upper'
            )
        if frame not in ('robot', 'world'):
            raise ValueError(f"frame: got {frame!r}, allowed are 'robot' and 'world'")
        if not (math.isfinite(edge) and edge >= 0.0):
            raise ValueError(f'edge: got {edge}, allowed are finite numbers from 0')
        super().__init__(probability)
        self.frame, self.edge = frame, float(edge)
        everywhere = [math.inf] * (3 - len(low))
        self._parameters[1:7] = [*low, *np.negative(everywhere), *high, *everywhere]
        self._parameters[7:] = self.edge, frame == 'robot'

    def softened(self, edge: float) -> BoxDetection:
        """Return the same box with a ramp of at least `edge` metres."""
        corners = self.lower.tolist(), self.upper.tolist()
        return BoxDetection(*corners, self.gain, self.frame, max(edge, self.edge))
