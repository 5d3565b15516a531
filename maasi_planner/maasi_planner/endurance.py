"""How far a robot can go and still come home, by its battery."""

import math

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.settings import NotNegative, Settings, Vector3
from maasi_planner.motion import MotionModel, Trajectories
from maasi_planner.obstacles import next_point

_LAST = 0.5  # share of the reserve that is left when a robot on its way turns home at once


class EnduranceSettings(Settings):
    """What the battery is used for, as shares of a full one, and where it is charged."""

    per_second: NotNegative = Field(
        0.0, description='Use at rest or hovering; of a flight of 20 minutes: 0.00083 [1/s]'
    )
    per_metre: NotNegative = Field(0.0, description='Use of a metre on top of it [1/m]')
    reserve: float = Field(
        0.25, ge=0.0, lt=1.0, description='Charge that is left when it is home [1]'
    )
    full: float = Field(0.95, gt=0.0, le=1.0, description='Charge at which it goes out again [1]')
    chargers: list[Vector3] = Field(
        default_factory=list, description='Where it is charged; none: at its start [m, map]'
    )


class Endurance:
    """The way home of one robot.

    settings: its use, and its chargers; motion: which knows the ways around obstacles; start (3,):
    its charger where none is named [m].
    """

    def __init__(self, settings: EnduranceSettings, motion: MotionModel, start: ArrayLike) -> None:
        self.settings, self.motion = settings, motion
        chargers: list[ArrayLike] = [*settings.chargers]
        self.chargers = np.array(chargers or [start], dtype=float)
        self.charge = math.nan  #: charge as it was last heard, 0 to 1; not a number: unknown
        self.charging = False  #: whether it is on its way to a charger, or charges
        self.spent = False  #: whether nothing else was affordable at the last decision

    def ways_home(self, position: ArrayLike) -> FloatArray:
        """Return the ways from a position to all chargers [m]."""
        x, y, z = np.asarray(position, dtype=float).tolist()
        lengths = []
        for charger in self.chargers.tolist():
            goal = (charger[0], charger[1], charger[2])
            keep_out = self.motion.keep_out
            _, left = next_point((x, y, z), goal, self.motion.table(goal), keep_out.around)
            lengths.append(left)
        return np.array(lengths)

    def chargers_within(self, position: ArrayLike) -> FloatArray:
        """Return the chargers (n, 3) that the battery reaches, nearest first; at least one."""
        lengths = self.ways_home(position)
        order = np.argsort(lengths, kind='stable')
        usable = [row for row in order if self._use(lengths[row]) <= self.charge]
        return self.chargers[usable or order[:1]]

    def is_home(self, position: ArrayLike) -> bool:
        """Return whether a robot is at a charger."""
        gaps = np.linalg.norm(self.chargers - np.asarray(position, dtype=float), axis=1)
        return bool(gaps.min() <= 2.0 * self.motion.settings.tolerance)

    def use_home(self, position: ArrayLike) -> float:
        """Return the share of the battery that the shortest way home takes."""
        return self._use(self.ways_home(position).min())

    def _use(self, way: float) -> float:
        metres = 1.1 * way  # a tenth for turns
        seconds = metres / self.motion.settings.speed + 1.0 / self.motion.rate
        return self.settings.per_second * seconds + self.settings.per_metre * metres

    def range_from(self, position: FloatArray) -> tuple[float, FloatArray]:
        """Return the longest way [m] that leaves the reserve, and the charger to end at, (3,)."""
        settings, speed = self.settings, self.motion.settings.speed
        use = 1.1 * (settings.per_metre + settings.per_second / speed)
        left = max(self.charge - settings.reserve, 0.0)
        known = use > 0.0 and not math.isnan(self.charge)
        nearest = int(np.argmin(self.ways_home(position)))
        return (left / use if known else math.inf), self.chargers[nearest]

    def affords(self, ways: Trajectories, step: float) -> BoolArray:
        """Return which predicted ways leave enough to come home with the reserve, (W,)."""
        allowed = np.ones(len(ways.lengths), dtype=bool)
        if math.isnan(self.charge):
            return allowed
        moved = np.linalg.norm(np.diff(ways.positions, axis=1), axis=2).sum(axis=1)
        used = self.settings.per_second * step * ways.lengths + self.settings.per_metre * moved
        left = self.charge - self.settings.reserve - used
        for row in np.flatnonzero(left >= 0.0):
            allowed[row] = left[row] >= self.use_home(ways.positions[row, -1])
        return allowed & (left >= 0.0)

    def must_return(self, position: ArrayLike) -> bool:
        """Return whether a robot on its way has to turn home now."""
        least = _LAST * self.settings.reserve
        return not self.charging and self.charge - least < self.use_home(position)

    def hear(self, charge: float) -> None:
        """Take the charge, 0 to 1; anything else is unknown."""
        self.charge = charge if 0.0 <= charge <= 1.0 else math.nan
        if self.charge >= self.settings.full:
            self.charging = False
