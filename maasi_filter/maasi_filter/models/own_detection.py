"""Detection models of plugins: pi as a compiled function or a NumPy function."""

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NoReturn

import numpy as np
from numba import njit
from pydantic import BaseModel

from maasi_filter.arrays import FloatArray
from maasi_filter.models.detection import CUSTOM, NUMBER, REACH, DetectionModel, register
from maasi_filter.plugins import PluginError
from maasi_filter.unexplored_map import interpolate_at

_CELLS = {2: 256, 3: 48}  # cells from the robot to the reach, on each axis, by dimension
_TRIALS = 64  # positions at which a compiled function is tried


class OwnDetection(DetectionModel):
    """pi(x, q) by your own function of the target's position relative to the robot.

    A subclass has `reach`, and either `compiled` with `values`, or `evaluate`; docs/plugins.md
    compares both. The result is multiplied by `probability` of the settings, and 0 beyond the
    reach. In 2D `up` is 0.

    Parameters
    ----------
    settings : BaseModel, optional
        Instance of `Settings`.
    probability : float
        G, factor on the result, in [0, 1].
    dimension : int
        2 or 3.

    Attributes
    ----------
    Settings : type or None
        Model of the settings that a scenario can set.
    compiled : function or None
        pi(forward, left, up, values) of floats [m] and the array `values`, decorated with
        `numba.njit` or plain.
    own : BaseModel or None
        The settings.

    Raises
    ------
    PluginError
        If the function does not return finite numbers in [0, 1].
    """

    Settings: ClassVar[type[BaseModel] | None] = None
    compiled: ClassVar[Callable[..., float] | None] = None
    _kind = CUSTOM

    def __init__(self, settings: Any = None, probability: float = 1.0, dimension: int = 3) -> None:
        super().__init__(probability)
        self.own = self.Settings() if settings is None and self.Settings is not None else settings
        self.dimension = dimension
        reach = float(self._numbers('reach', self.reach(), ()))
        if not 0.0 < reach < math.inf:
            self._refuse(f'reach: got {reach}, allowed are finite numbers above 0')
        function = type(self).compiled
        if function is None:
            function, values = _interpolated, self._table(reach)
        else:
            values = self._numbers('values', self.values()).ravel()
            # Tried first where exceptions are still visible.
            positions = np.random.default_rng(1).uniform(-reach, reach, (_TRIALS, 3))
            positions[:, dimension:] = positions[0] = 0.0
            results = [function(*position, values) for position in positions.tolist()]
            self._probabilities('compiled', results, _TRIALS)
        # As for the radial models: the inverse of half the width of the view.
        self._parameters[1 : 1 + dimension] = 2.0 / reach
        self._parameters[REACH] = reach
        self._parameters[NUMBER:] = register(function, values)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.own, self.gain, self.dimension)

    def reach(self) -> float:
        """Return the largest distance of a detection, metres."""
        self._refuse('lacks reach')

    def values(self) -> Sequence[float]:
        """Return the numbers that the compiled function uses."""
        return ()

    def evaluate(self, forward: FloatArray, left: FloatArray, up: FloatArray) -> FloatArray:
        """Return pi (n,) of targets at offsets (n,) each in the robot's axes, metres."""
        self._refuse('lacks compiled or evaluate')

    def _refuse(self, problem: str) -> NoReturn:
        raise PluginError(f'{type(self).__module__}:{type(self).__qualname__}: {problem}')

    def _numbers(self, what: str, value: Any, shape: tuple[int, ...] | None = None) -> FloatArray:
        """Return the result of a method as numbers, of a shape if one is given."""
        try:
            found = np.asarray(value, dtype=float)
        except (TypeError, ValueError):  # rows of unequal lengths too
            self._refuse(f'{what}: got {value!r:.80}, allowed are numbers')
        if shape is not None and found.shape != shape:
            self._refuse(f'{what}: got shape {found.shape}, allowed is {shape}')
        return found

    def _probabilities(self, what: str, value: Any, number: int) -> FloatArray:
        found = self._numbers(what, value, (number,))
        wrong = found[~((found >= 0.0) & (found <= 1.0))]
        if wrong.size:
            self._refuse(f'{what}: got a probability of {wrong[0]}, allowed are numbers in [0, 1]')
        return found

    def _table(self, reach: float) -> FloatArray:
        """Return corner, step and shape of a grid, and pi on it, for `_interpolated`."""
        cells = _CELLS[self.dimension]
        axis = np.linspace(-reach, reach, 2 * cells + 1)
        height = axis if self.dimension == 3 else np.zeros(1)
        positions = np.stack(np.meshgrid(axis, axis, height, indexing='ij')).reshape(3, -1)
        table = self._probabilities('evaluate', self.evaluate(*positions), positions.shape[1])
        return np.concatenate([[-reach] * 3, [reach / cells] * 3, [len(axis), len(height)], table])


@njit(cache=True, error_model='numpy')
def _interpolated(forward, left, up, values):  # type: ignore[no-untyped-def]
    width, depth = np.int64(values[6]), np.int64(values[7])
    grid = values[8:].reshape((width, width, depth))
    return interpolate_at(grid, values[:3], values[3:6], forward, left, up)
