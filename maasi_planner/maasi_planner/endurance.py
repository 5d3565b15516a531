"""Battery of a robot: charge, use in flight, and the path home."""

import math
from collections.abc import Callable
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.settings import NotNegative, Settings, Vector3
from maasi_planner.motion import MotionModel, RobotState, Trajectories
from maasi_planner.motion.base import STEPS_LIMIT

# Parts of a path home that is longer than the longest prediction.
_PARTS = 20
# Upper bound of learned ratios of real to predicted use and time.
_LARGEST_RATIO = 3.0
# Windows of predicted use and predicted time [s] of ratios, and their priors of ratio 1.
_USE_WINDOW, _USE_PRIOR = 0.25, 0.02
_TIME_WINDOW, _TIME_PRIOR = 60.0, 5.0
# At a charger: shares of a full battery that count as gained or lost, and the time without a gain
# after which the robot counts as not charged [s].
_GAINED, _LOST, CHARGING_PATIENCE = 0.005, 0.02, 180.0
# The charge of a robot may fall for so long after its arrival, until it rests at the charger [s].
_SETTLING = 10.0
# Target charge of a robot that can afford nothing with `full`.
_TOP = 0.999
#: Reasons of done robots.
NOT_CHARGED = 'its charge does not rise at the charger'
NOTHING_AFFORDABLE = 'a full battery does not suffice for any remaining position'
SEARCH_ENDED = 'the search has ended'
# Margin of planned legs, as a share of the use of the path home.
_MARGIN = 0.03


class EnduranceSettings(Settings):
    """Battery use as shares of a full battery, and chargers."""

    per_second: NotNegative = Field(
        0.0,
        description='Share of the battery used per second at rest or hovering; a flight time of '
        '20 minutes is 0.00083 [1/s]',
    )
    per_metre: NotNegative = Field(0.0, description='Additional share used per metre [1/m]')
    reserve: float = Field(
        0.25, ge=0.0, lt=1.0, description='Charge with which the robot arrives home [1]'
    )
    full: float = Field(
        0.95, gt=0.0, le=1.0, description='Charge at which the robot leaves the charger [1]'
    )
    chargers: list[Vector3] = Field(
        default_factory=list,
        description='Positions of chargers; default: the start; in 2D their height is that of the '
        'start [m, map]',
    )
    return_factor: float = Field(
        1.0,
        ge=1.0,
        le=5.0,
        description='Factor on the predicted use of the path home, for example for headwind [1]',
    )


class Phase(Enum):
    """Phase of a robot with a battery."""

    AVAILABLE = 'available'  #: the planner decides where it goes
    RETURNING = 'returning'  #: on its path to a charger
    CHARGING = 'charging'  #: at a charger
    DONE = 'done'  #: goes home and stays there


class HomePaths:
    """Cached time and length of paths from rest to the chargers; nearby positions share a path."""

    def __init__(self, motion: MotionModel, chargers: FloatArray, step: float) -> None:
        self._motion, self._chargers, self._step = motion, chargers, step
        settings = motion.settings
        self._cell = max(4.0 * settings.tolerance, 0.2 * settings.speed)
        self._known: dict[tuple[int, ...], tuple[FloatArray, float, float]] = {}

    def clear(self) -> None:
        """Forget all paths after a change of the area."""
        self._known.clear()

    def least(self, row: int, position: FloatArray) -> float:
        """Return a lower bound of the length of the path to a charger [m]."""
        straight = math.sqrt(self._motion.squared_distance(position, self._chargers[row]))
        return max(straight - self._motion.settings.tolerance, 0.0)

    def path(self, row: int, position: FloatArray) -> tuple[float, float]:
        """Return time [s] and length [m] of the path to a charger, or inf."""
        key = row, *np.floor(position / self._cell).astype(int).tolist()
        if key not in self._known:
            at_rest = RobotState.at_rest(position)
            self._known[key] = np.array(position), *self.predict(row, at_rest)
        near, seconds, metres = self._known[key]
        gap = math.dist(near, position)
        return seconds + gap / self._motion.settings.speed, metres + gap

    def predict(self, row: int, state: RobotState) -> tuple[float, float]:
        """Return time [s] and length [m] of the path from a state to a charger, or inf."""
        goal, seconds, metres = self._chargers[row][None, :], 0.0, 0.0
        if math.isinf(self._motion.keep_out.path_length(state.pose.position, goal[0])):
            return math.inf, math.inf
        for _ in range(_PARTS):
            path = self._motion.predict(state, goal, self._step)
            seconds += self._step * int(path.lengths[0])
            moved = float(path.distances()[0])
            metres += moved
            if path.reached[0]:
                return seconds, metres
            if path.lengths[0] < STEPS_LIMIT or moved < self._motion.settings.tolerance:
                break
            state = RobotState.at_rest(path.positions[0, -1], float(path.yaws[0, -1]))
        return math.inf, math.inf


class Ratio:
    """Ratio of measured to predicted values, at least 1, averaged over a window."""

    def __init__(self, window: float, prior: float) -> None:
        self._window, self._prior = window, prior
        self._measured = self._predicted = 0.0

    def add(self, measured: float, predicted: float) -> None:
        """Add values; older ones fade."""
        fading = math.exp(-max(measured, predicted, 0.0) / self._window)
        self._measured = fading * self._measured + measured
        self._predicted = fading * self._predicted + predicted

    @property
    def value(self) -> float:
        """The ratio."""
        ratio = (self._measured + self._prior) / (self._predicted + self._prior)
        return min(max(ratio, 1.0), _LARGEST_RATIO)


class Endurance:
    """The battery of one robot, and its paths home.

    At each step the coordinator calls `update`, and `begin` with the decided phase.
    """

    def __init__(
        self, settings: EnduranceSettings, motion: MotionModel, start: ArrayLike, step: float = 0.1
    ) -> None:
        self.settings, self.motion, self._step = settings, motion, step
        chargers: list[ArrayLike] = [*settings.chargers]
        self.chargers = np.array(chargers or [start], dtype=float)
        area = motion.keep_out.area
        self._level = area is None or area.dimension == 2
        if self._level:
            # In 2D a drone hovers above a charger.
            self.chargers[:, 2] = np.asarray(start, dtype=float)[2]
        self._paths = HomePaths(motion, self.chargers, step)
        self.charge = math.nan  #: 0 to 1; NaN: never known
        self.estimated = False  #: whether the charge is an estimate
        self.phase = Phase.AVAILABLE
        self.done_reason = ''  #: why the robot is done; empty if it is not
        self.cut_off = False  #: whether no path leads to any charger
        self.must_return = False  #: whether the robot has to go home now
        self.leg = 0.0  #: share of the battery that its remaining path uses
        self._use, self._pace = Ratio(_USE_WINDOW, _USE_PRIOR), Ratio(_TIME_WINDOW, _TIME_PRIOR)
        self._before: tuple[int, FloatArray] | None = None
        # Reached index of the predicted path, and its step.
        self._progress, self._progress_at = 0, 0
        # Charge beyond the last prediction of the path home, less twice the use after it, as the
        # flight back uses as much again. None: no prediction.
        self._slack: float | None = None
        # Highest charge at the charger, the time without a rise, and the time there [s].
        self._peak = math.nan
        self._waited, self._stayed, self._target = 0.0, 0.0, settings.full
        #: Whether it has the highest charge that its charger gives.
        self.topped = False

    # ---- queries -----------------------------------------------------------------------------

    @property
    def charging(self) -> bool:
        """Whether the robot charges, or is on its path to a charger."""
        return self.phase in (Phase.RETURNING, Phase.CHARGING)

    @property
    def full(self) -> bool:
        """Whether the robot is charged enough to go out, or its charge is unknown."""
        return not self.charge < self.settings.full

    @property
    def short(self) -> bool:
        """Whether the battery is expected to be empty before the robot is at any charger."""
        slack = math.inf if self._slack is None else self._slack
        return self.must_return and not self.cut_off and slack + self.settings.reserve < 0.0

    @property
    def use_ratio(self) -> float:
        """Learned ratio of real to predicted use, at least 1."""
        return self._use.value

    @property
    def time_ratio(self) -> float:
        """Learned ratio of real to predicted time of paths, at least 1."""
        return self._pace.value

    def describe(self) -> str:
        """Return the charge as text."""
        if math.isnan(self.charge):
            return 'its charge is unknown'
        word = 'estimated at' if self.estimated else 'at'
        return f'its battery is {word} {100.0 * self.charge:.0f} %'

    def is_home(self, position: ArrayLike) -> bool:
        """Return whether a position is at a charger; in 2D at any height."""
        here = np.asarray(position, dtype=float)
        if self._level:
            gaps = np.linalg.norm((self.chargers - here)[:, :2], axis=1)
            return bool(gaps.min() <= 2.0 * self.motion.settings.tolerance)
        least = min(self.motion.squared_distance(here, charger) for charger in self.chargers)
        return bool(least <= 4.0 * self.motion.settings.tolerance**2)

    def use(self, seconds: float, metres: float) -> float:
        """Return the share of the battery that a predicted path uses."""
        if math.isinf(metres):
            return math.inf
        settings = self.settings
        used = settings.per_second * seconds * self.time_ratio + settings.per_metre * metres
        return used * self.use_ratio

    def use_home(self, position: ArrayLike) -> float:
        """Return the share that the cheapest path home from rest uses, or inf."""
        here = np.asarray(position, dtype=float)
        return self._cheapest(here, self._paths.path)

    def chargers_within(self, position: ArrayLike) -> FloatArray:
        """Return the chargers (n, 3) within reach of the battery, nearest first; at least one."""
        here = np.asarray(position, dtype=float)
        uses = [self._to_charger(row, here) for row in range(len(self.chargers))]
        order = np.argsort(uses, kind='stable')
        usable = [row for row in order if uses[row] <= self.charge]
        return self.chargers[usable or order[:1]]

    def range_from(self, position: FloatArray) -> tuple[float, FloatArray]:
        """Return the longest path [m] beyond the present one that leaves the reserve, and its end.

        With an unknown charge, or without use, the range is infinite and the end is the position.
        """
        if math.isnan(self.charge) or math.isinf(self.full_range()):
            return math.inf, np.array(position)
        uses = [self._to_charger(row, position) for row in range(len(self.chargers))]
        return self._range(self.charge - self.leg), self.chargers[int(np.argmin(uses))]

    def full_range(self) -> float:
        """Return the longest path [m] after a charge that leaves the reserve."""
        return self._range(self.settings.full)

    def _range(self, charge: float) -> float:
        use = self.use(1.0 / self.motion.settings.speed, 1.0)
        left = max(charge - self.settings.reserve - self._margin(0.0), 0.0)
        return left / use if use > 0.0 else math.inf

    def affords(self, paths: Trajectories, step: float) -> BoolArray:
        """Return which predicted paths leave enough charge to get home with the reserve, (W,)."""
        allowed = np.ones(len(paths.lengths), dtype=bool)
        if math.isnan(self.charge):
            return allowed
        seconds, settings = step * paths.lengths, self.settings
        used = settings.per_second * seconds * self.time_ratio
        used = (used + settings.per_metre * paths.distances()) * self.use_ratio
        left = self.charge - settings.reserve - used
        for row in range(len(allowed)):
            end = paths.positions[row, -1]
            # Bounds exclude most rows without a prediction.
            bounds = [self._least_use(charger, end) for charger in range(len(self.chargers))]
            allowed[row] = left[row] - self._margin(0.0) >= min(bounds)
            if allowed[row]:
                home = self.use_home(end)
                allowed[row] = left[row] >= home + self._margin(home)
        return allowed

    def _least_use(self, row: int, position: FloatArray) -> float:
        metres = self._paths.least(row, position)
        return self.settings.return_factor * self.use(metres / self.motion.settings.speed, metres)

    def _to_charger(self, row: int, position: FloatArray) -> float:
        return self.settings.return_factor * self.use(*self._paths.path(row, position))

    def _cheapest(
        self, position: FloatArray, path: Callable[[int, FloatArray], tuple[float, float]]
    ) -> float:
        """Return the use of the cheapest path home; paths that cannot be it are not predicted."""
        bounds = [self._least_use(row, position) for row in range(len(self.chargers))]
        best = math.inf
        for row in np.argsort(bounds, kind='stable').tolist():
            if bounds[row] >= best:
                break
            best = min(best, self.settings.return_factor * self.use(*path(row, position)))
        return best

    def _margin(self, home: float) -> float:
        """Return the margin of a planned leg beyond the reserve, by the use of the path home."""
        seconds = 2.0 / self.motion.rate
        metres = seconds * self.motion.settings.speed
        return self.use(seconds, metres) + _MARGIN * home

    # ---- changes -----------------------------------------------------------------------------

    def update_charge(self, charge: float) -> None:
        """Update with a reported charge, 0 to 1; anything else is unknown."""
        known = 0.0 <= charge <= 1.0
        self.estimated = not (known or math.isnan(self.charge))
        if known:
            self.charge = float(charge)

    def adopt_area(self) -> None:
        """Forget predicted paths home after a change of the area."""
        self._paths.clear()
        self._slack = None

    def begin(self, phase: Phase, reason: str = '') -> None:
        """Enter a phase; reason: why the robot is done."""
        self.phase, self.done_reason = phase, reason if phase is Phase.DONE else ''
        self._peak, self._waited, self._stayed = math.nan, 0.0, 0.0
        self._target = self.settings.full
        self.topped = False

    def top(self) -> None:
        """Charge beyond `full`, as nothing is affordable with it."""
        if self.phase is not Phase.CHARGING:
            self.begin(Phase.CHARGING)
        self._target = _TOP

    def begin_again(self) -> None:
        """Begin a new search; learned ratios are retained."""
        self.begin(Phase.AVAILABLE)
        self.leg, self._slack, self.must_return = 0.0, None, False

    def note_pace(self, seconds: float, predicted: float) -> None:
        """Note real and predicted time of a part of a path [s]."""
        self._pace.add(seconds, predicted)

    def begin_path(self, step: int) -> None:
        """Note the begin of a path."""
        self._progress, self._progress_at = 0, step

    def note_progress(self, step: int, position: FloatArray, path: FloatArray) -> None:
        """Learn from the progress on the predicted path (n, 3)."""
        last = len(path) - 1
        if self._progress >= last:
            return
        gone = step - self._progress_at
        ahead = path[self._progress : min(self._progress + 3 * gone + 1, last) + 1] - position
        reached = int(np.argmin((ahead * ahead).sum(axis=1)))
        self._progress, self._progress_at = self._progress + reached, step
        # At the end the robot slows down, or turns to the next waypoint.
        if self._progress < last:
            self.note_pace(gone * self._step, reached * self._step)

    def plan_leg(self, path: FloatArray) -> None:
        """Note the remaining present path, (n, 3), which may be empty."""
        metres = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        self.leg = self.use(self._step * (len(path) - 1), metres) if len(path) else 0.0

    def update(self, step: int, state: RobotState, charge: float, stands: bool) -> None:
        """Update with the state and charge of a step; stands: without a goal that has not ended."""
        here, before = np.array(state.pose.position), self.charge
        seconds, predicted = 0.0, 0.0
        if self._before is not None:
            seconds = max(step - self._before[0], 0) * self._step
            metres = math.dist(here, self._before[1])
            predicted = self.settings.per_second * seconds + self.settings.per_metre * metres
        self._before = step, here
        home = stands and self.is_home(here)
        self.update_charge(charge)
        if self.estimated and not home:
            self.charge = max(before - predicted * self.use_ratio, 0.0)
        # A jump upwards is a replaced battery.
        elif not home and predicted > 0.0 and self.charge <= before + _GAINED:
            self._use.add(before - self.charge, predicted)
        if math.isnan(before) and not math.isnan(self.charge):
            self._slack = None
        if self._slack is not None:
            used = 0.0 if math.isnan(before) else max(before - self.charge, 0.0)
            used = max(used, predicted * self.use_ratio)
            self._slack -= (1.0 + self.settings.return_factor) * used
        self._check_return(state, home)
        self._check_charging(home, seconds)

    def _check_return(self, state: RobotState, home: bool) -> None:
        """Predict the path home unless the charge is surely sufficient."""
        settings, here = self.settings, np.asarray(state.pose.position, dtype=float)
        if home:
            self._slack, self.cut_off, self.must_return = None, False, False
            return
        if self._slack is None or self._slack <= 2.0 * self._margin(0.0):
            use = self._cheapest(here, lambda row, _: self._paths.predict(row, state))
            next_step = self.use(self._step, self._step * self.motion.settings.speed)
            self.cut_off = math.isinf(use)
            self._slack = self.charge - settings.reserve - use - 2.0 * next_step
            if math.isnan(self.charge):
                self._slack = math.inf  # unknown charge
        self.must_return = self._slack < 0.0

    def _check_charging(self, home: bool, seconds: float) -> None:
        """Begin to charge, complete it, or give up as the charge does not rise."""
        # The battery was replaced, or the charger works again.
        not_charged = self.done_reason == NOT_CHARGED
        if not_charged and self.charge > self._peak + _GAINED:
            self.begin(Phase.CHARGING)
        if self.phase is Phase.RETURNING and home:
            self.begin(Phase.CHARGING)
        if self.phase is not Phase.CHARGING:
            return
        if not home:
            self.begin(Phase.RETURNING)
            return
        self._stayed += seconds
        if not self.charge <= self._peak + _GAINED:
            self._peak, self._waited = self.charge, 0.0
        else:
            self._waited += seconds
        if self._stayed < _SETTLING:
            self._peak = min(self._peak, self.charge)
        lost = not self.estimated and self.charge < self._peak - _LOST
        over = lost or self._waited > CHARGING_PATIENCE
        if self.charge >= self._target or (over and self.charge >= self.settings.full):
            topped = self._target == _TOP
            self.begin(Phase.AVAILABLE)
            self.topped = topped
        elif over:
            charge = self.charge
            self.begin(Phase.DONE, NOT_CHARGED)
            self._peak = charge
