"""Battery of a robot: its charge, what flying uses, and whether it still comes home."""

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
# Bounds of the learned ratios of real to predicted use, and to predicted time.
_LARGEST_RATIO = 3.0
# Predicted use, and predicted time [s], over which ratios are averaged, and that count as ratio 1.
_USE_WINDOW, _USE_PRIOR = 0.25, 0.02
_TIME_WINDOW, _TIME_PRIOR = 60.0, 5.0
# At a charger: shares of a full battery that count as gained or lost, and the longest time without
# a gain until the robot counts as not charged [s].
_GAINED, _LOST, CHARGING_PATIENCE = 0.005, 0.02, 180.0
# Charge that counts as a full battery, of a robot that affords nothing with less.
_TOP = 0.999
#: Why a robot is done.
NOT_CHARGED = 'it is not charged at its charger'
NOTHING_AFFORDABLE = 'no position that is left is affordable with a full battery'
SEARCH_ENDED = 'the search has ended'
# Share of the use of the path home that a planned leg leaves on top of the reserve.
_MARGIN = 0.03


class EnduranceSettings(Settings):
    """What the battery is used for, as shares of a full one, and where it is charged."""

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
    """What a robot does by its battery."""

    AVAILABLE = 'available'  #: the planner decides where it goes
    RETURNING = 'returning'  #: on its way to a charger
    CHARGING = 'charging'  #: at a charger
    DONE = 'done'  #: goes home, and stays there


class HomePaths:
    """Predicted time and length of the paths from rest at a position to the chargers.

    A position near one that was predicted takes the path of that one and the distance between them.
    """

    def __init__(self, motion: MotionModel, chargers: FloatArray, step: float) -> None:
        self._motion, self._chargers, self._step = motion, chargers, step
        settings = motion.settings
        self._cell = max(4.0 * settings.tolerance, 0.2 * settings.speed)
        self._known: dict[tuple[int, ...], tuple[FloatArray, float, float]] = {}

    def clear(self) -> None:
        """Forget all paths, as the area is another one."""
        self._known.clear()

    def least(self, row: int, position: FloatArray) -> float:
        """Return a length that no path to a charger is shorter than [m]."""
        straight = math.sqrt(self._motion.squared_distance(position, self._chargers[row]))
        return max(straight - self._motion.settings.tolerance, 0.0)

    def path(self, row: int, position: FloatArray) -> tuple[float, float]:
        """Return time [s] and length [m] of the path to a charger; infinite if there is none."""
        key = row, *np.floor(position / self._cell).astype(int).tolist()
        if key not in self._known:
            at_rest = RobotState.at_rest(position)
            self._known[key] = np.array(position), *self.predict(row, at_rest)
        near, seconds, metres = self._known[key]
        gap = math.dist(near, position)
        return seconds + gap / self._motion.settings.speed, metres + gap

    def predict(self, row: int, state: RobotState) -> tuple[float, float]:
        """Return the same from a state."""
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
    """A ratio of what was measured to what was predicted, 1 at least, averaged over a window."""

    def __init__(self, window: float, prior: float) -> None:
        self._window, self._prior = window, prior
        self._measured = self._predicted = 0.0

    def add(self, measured: float, predicted: float) -> None:
        """Take further values, of which older ones fade."""
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

    Queries change nothing. Of each step the coordinator calls `update` once, and `begin` with the
    phase that it has decided.

    settings: use and chargers; motion: predicts the paths home; start (3,): charger where none is
    named [m]; step: of the predictions [s].
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
            # A charger on the ground is below a drone that hovers over it.
            self.chargers[:, 2] = np.asarray(start, dtype=float)[2]
        self._paths = HomePaths(motion, self.chargers, step)
        self.charge = math.nan  #: 0 to 1; not a number: it was never known
        self.estimated = False  #: whether the charge is an estimate, as no more is reported
        self.phase = Phase.AVAILABLE
        self.done_reason = ''  #: why it is done; empty if it is not
        self.cut_off = False  #: whether no path leads to any charger
        self.must_return = False  #: whether it has to go home now
        self.leg = 0.0  #: share of the battery that the rest of its present path takes
        self._use, self._pace = Ratio(_USE_WINDOW, _USE_PRIOR), Ratio(_TIME_WINDOW, _TIME_PRIOR)
        self._before: tuple[int, FloatArray] | None = None
        # Index on its predicted path that it has reached, and at which step.
        self._progress, self._progress_at = 0, 0
        # Charge that remained beyond the path home when it was predicted last, less twice what was
        # used since: to fly back what it has flown takes as much again. None: to be predicted.
        self._slack: float | None = None
        # Highest charge since it is at a charger, and since when it has not risen [s].
        self._peak = math.nan
        self._waited, self._target = 0.0, settings.full
        #: Whether it has charged all that its charger gives.
        self.topped = False

    # ---- queries -----------------------------------------------------------------------------

    @property
    def charging(self) -> bool:
        """Whether it is on its way to a charger, or charges."""
        return self.phase in (Phase.RETURNING, Phase.CHARGING)

    @property
    def full(self) -> bool:
        """Whether it is charged enough to go out; also while its charge is unknown."""
        return not self.charge < self.settings.full

    @property
    def short(self) -> bool:
        """Whether its battery is expected to be empty before it is at any charger."""
        slack = math.inf if self._slack is None else self._slack
        return self.must_return and not self.cut_off and slack + self.settings.reserve < 0.0

    @property
    def use_ratio(self) -> float:
        """Real use as a multiple of the use by the settings, as it was learned; 1 at least."""
        return self._use.value

    @property
    def time_ratio(self) -> float:
        """Real time of paths as a multiple of the predicted one, as learned; 1 at least."""
        return self._pace.value

    def describe(self) -> str:
        """Return the charge as text."""
        if math.isnan(self.charge):
            return 'its battery is unknown'
        word = 'estimated at' if self.estimated else 'at'
        return f'its battery is {word} {100.0 * self.charge:.0f} %'

    def is_home(self, position: ArrayLike) -> bool:
        """Return whether a robot is at a charger; in 2D at any height."""
        here = np.asarray(position, dtype=float)
        if self._level:
            gaps = np.linalg.norm((self.chargers - here)[:, :2], axis=1)
            return bool(gaps.min() <= 2.0 * self.motion.settings.tolerance)
        least = min(self.motion.squared_distance(here, charger) for charger in self.chargers)
        return bool(least <= 4.0 * self.motion.settings.tolerance**2)

    def use(self, seconds: float, metres: float) -> float:
        """Return the share of the battery that a predicted path takes."""
        if math.isinf(metres):
            return math.inf
        settings = self.settings
        used = settings.per_second * seconds * self.time_ratio + settings.per_metre * metres
        return used * self.use_ratio

    def use_home(self, position: ArrayLike) -> float:
        """Return the share that the cheapest path home from rest takes; infinite without any."""
        here = np.asarray(position, dtype=float)
        return self._cheapest(here, self._paths.path)

    def chargers_within(self, position: ArrayLike) -> FloatArray:
        """Return the chargers (n, 3) that the battery reaches, nearest first; at least one."""
        here = np.asarray(position, dtype=float)
        uses = [self._to_charger(row, here) for row in range(len(self.chargers))]
        order = np.argsort(uses, kind='stable')
        usable = [row for row in order if uses[row] <= self.charge]
        return self.chargers[usable or order[:1]]

    def range_from(self, position: FloatArray) -> tuple[float, FloatArray]:
        """Return the longest path [m] that leaves the reserve, and its end, (3,).

        The rest of the present path is paid before. Where the charge is unknown, or nothing is
        used, the range is infinite and the end is the position itself.
        """
        settings, speed = self.settings, self.motion.settings.speed
        use = 1.1 * self.use(1.0 / speed, 1.0)
        if math.isnan(self.charge) or use <= 0.0:
            return math.inf, np.array(position)
        uses = [self._to_charger(row, position) for row in range(len(self.chargers))]
        left = max(self.charge - settings.reserve - self.leg - self._margin(0.0), 0.0)
        return left / use, self.chargers[int(np.argmin(uses))]

    def affords(self, ways: Trajectories, step: float) -> BoolArray:
        """Return which predicted paths leave enough to come home with the reserve, (W,)."""
        allowed = np.ones(len(ways.lengths), dtype=bool)
        if math.isnan(self.charge):
            return allowed
        seconds, settings = step * ways.lengths, self.settings
        used = settings.per_second * seconds * self.time_ratio
        used = (used + settings.per_metre * ways.distances()) * self.use_ratio
        left = self.charge - settings.reserve - used
        for row in range(len(allowed)):
            end = ways.positions[row, -1]
            # Most rows that are too far are known without a prediction.
            bounds = [self._least_use(charger, end) for charger in range(len(self.chargers))]
            allowed[row] = left[row] - self._margin(0.0) >= min(bounds)
            if allowed[row]:
                home = self.use_home(end)
                allowed[row] = left[row] >= home + self._margin(home)
        return allowed

    def _least_use(self, row: int, position: FloatArray) -> float:
        """Return a lower bound of the use of the path to a charger."""
        metres = self._paths.least(row, position)
        return self.settings.return_factor * self.use(metres / self.motion.settings.speed, metres)

    def _to_charger(self, row: int, position: FloatArray) -> float:
        return self.settings.return_factor * self.use(*self._paths.path(row, position))

    def _cheapest(
        self, position: FloatArray, path: Callable[[int, FloatArray], tuple[float, float]]
    ) -> float:
        """Return the use of the cheapest path home, without predicting those that cannot be it."""
        bounds = [self._least_use(row, position) for row in range(len(self.chargers))]
        best = math.inf
        for row in np.argsort(bounds, kind='stable').tolist():
            if bounds[row] >= best:
                break
            best = min(best, self.settings.return_factor * self.use(*path(row, position)))
        return best

    def _margin(self, home: float) -> float:
        """Return what a planned leg leaves on top of the reserve, by the use of the path home.

        It is for turning round at speed, and for what is learned on the way.
        """
        seconds = 2.0 / self.motion.rate
        metres = seconds * self.motion.settings.speed
        return self.use(seconds, metres) + _MARGIN * home

    # ---- changes -----------------------------------------------------------------------------

    def update_charge(self, charge: float) -> None:
        """Take a charge that was reported, 0 to 1; anything else is unknown."""
        known = 0.0 <= charge <= 1.0
        self.estimated = not (known or math.isnan(self.charge))
        if known:
            self.charge = float(charge)

    def adopt_area(self) -> None:
        """Note that the area has changed: paths home are predicted again."""
        self._paths.clear()
        self._slack = None

    def begin(self, phase: Phase, reason: str = '') -> None:
        """Enter a phase; reason: why it is done."""
        self.phase, self.done_reason = phase, reason if phase is Phase.DONE else ''
        self._peak, self._waited, self._target = math.nan, 0.0, self.settings.full
        self.topped = False

    def top(self) -> None:
        """Charge beyond `full`, as nothing is affordable with it."""
        if self.phase is not Phase.CHARGING:
            self.begin(Phase.CHARGING)
        self._target = _TOP

    def begin_again(self) -> None:
        """Begin a new search; what was learned is kept."""
        self.begin(Phase.AVAILABLE)
        self.leg, self._slack, self.must_return = 0.0, None, False

    def note_pace(self, seconds: float, predicted: float) -> None:
        """Note the time in which a part of a predicted path was flown, and the predicted time."""
        self._pace.add(seconds, predicted)

    def begin_path(self, step: int) -> None:
        """Note that another path begins."""
        self._progress, self._progress_at = 0, step

    def note_progress(self, step: int, position: FloatArray, path: FloatArray) -> None:
        """Learn from how far it has come on its predicted path (n, 3) since the last step."""
        last = len(path) - 1
        if self._progress >= last:
            return
        gone = step - self._progress_at
        ahead = path[self._progress : min(self._progress + 3 * gone + 1, last) + 1] - position
        reached = int(np.argmin((ahead * ahead).sum(axis=1)))
        self._progress, self._progress_at = self._progress + reached, step
        # At its end it slows down, and may turn to the next waypoint.
        if self._progress < last:
            self.note_pace(gone * self._step, reached * self._step)

    def plan_leg(self, path: FloatArray) -> None:
        """Note the rest of its present path, (n, 3), which is empty where it stands."""
        metres = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        self.leg = self.use(self._step * (len(path) - 1), metres) if len(path) else 0.0

    def update(self, step: int, state: RobotState, charge: float, stands: bool) -> None:
        """Take the state and the charge of a step.

        stands: whether the robot has no goal, or has ended its last one.
        """
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
        # A jump upwards is another battery.
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
        """Predict the path home, unless there is enough for it for sure."""
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
                self._slack = math.inf  # until it is known
        self.must_return = self._slack < 0.0

    def _check_charging(self, home: bool, seconds: float) -> None:
        """Begin to charge, be full, or be done as the charge does not rise."""
        # Of a robot that was not charged a battery is exchanged, or the charger works again.
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
        if not self.charge <= self._peak + _GAINED:
            self._peak, self._waited = self.charge, 0.0
        else:
            self._waited += seconds
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
