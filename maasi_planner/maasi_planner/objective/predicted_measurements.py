"""Predicted measurements along trajectories, and what they leave unseen."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.geometry.terrain import hides
from maasi_filter.models.detection import (
    BOX,
    CUSTOM,
    PARAMETERS,
    REACH,
    DetectionModel,
    detection_probability_at,
    fill_probabilities,
)
from maasi_planner.motion.base import Trajectories
from maasi_planner.objective.sight import CLEAR, Sight, is_hidden, layer_of
from maasi_planner.team import RobotView

NEVER = 1 << 60  # after every measurement [steps]
MOST_CHANCES = 500_000  # largest part of `chances`
# Over terrain, share of the best detection below which it is neglected: lines of sight take time.
NEGLIGIBLE = 0.02
# x, y and z (n,) [m] in separate arrays, so that loops are vectorised.
Axes = tuple[FloatArray, FloatArray, FloatArray]


class Measurements(NamedTuple):
    """Predicted measurements on G trajectories of R robots, in order of time.

    Trajectory g of robot[g] has number[g] measurements: own[g] planned ones, and others that only
    other robots expect. times (G, n) [steps from now], positions (G, n, 3) [m], in 2D with z = 0,
    yaws (G, n) [rad]. For each robot kind (R,) and parameters (R, PARAMETERS) of pi, its reach (R,)
    [m], and the layer (R,) of its height in `sight`, which is what terrain hides.
    """

    robot: IntArray
    number: IntArray
    own: IntArray
    times: IntArray
    positions: FloatArray
    yaws: FloatArray
    kind: IntArray
    parameters: FloatArray
    reach: FloatArray
    layer: IntArray
    sight: Sight


class Paths(NamedTuple):
    """Trajectories (W, K + 1) of `lengths` steps of a robot, and its measurements on them.

    The first is after `phase` steps, others follow in every period and, with `arrival`, at the end.
    Positions are `stride` steps apart, of which phase and period are multiples, and at the end.
    """

    view: RobotView
    positions: FloatArray
    yaws: FloatArray
    lengths: IntArray
    phase: int
    arrival: bool
    stride: int = 1


@dataclass
class CoarseTrajectories(Trajectories):
    """Trajectories with only each `stride`-th position and the end."""

    stride: int
    metres: FloatArray

    @classmethod
    def of(cls, exact: Trajectories, stride: int) -> CoarseTrajectories:
        """Return them from all positions."""
        last = exact.positions.shape[1] - 1
        steps = np.minimum(np.arange(-(-last // stride) + 1) * stride, last)
        return cls(
            exact.positions[:, steps],
            exact.yaws[:, steps],
            exact.lengths,
            exact.control_cost,
            exact.reached,
            stride,
            exact.distances(),
        )

    def distances(self) -> FloatArray:
        """See `Trajectories.distances`."""
        return self.metres


def planned_paths(view: RobotView, prediction: Trajectories, arrival: bool) -> Paths:
    """Return the trajectories of a planning robot, which measures now."""
    stride = prediction.stride if isinstance(prediction, CoarseTrajectories) else 1
    return Paths(
        view, prediction.positions, prediction.yaws, prediction.lengths, 0, arrival, stride
    )


def path_ahead(view: RobotView) -> Paths:
    """Return the trajectory of a robot that does not plan."""
    path, yaws = view.remaining_path, view.remaining_yaws
    if view.planning or path is None or len(path) == 0:
        path, yaws = np.array(view.state.pose.position)[None, :], None
    if yaws is None:
        yaws = np.full(len(path), view.state.pose.yaw)
    # The robot plans, and therefore measures, at the end of its path.
    lengths, arrival = np.array([len(path) - 1]), view.planning or len(path) > 1
    return Paths(view, path[None], yaws[None], lengths, max(0, view.phase), arrival)


@njit(cache=True)
def _fill(
    out: Measurements,
    row: int,
    positions: FloatArray,
    yaws: FloatArray,
    lengths: IntArray,
    timing: tuple[int, int, int, bool, int],
    dimension: int,
) -> None:
    """Fill the rows of a robot from `row` on; timing: phase, period, horizon, arrival, stride."""
    phase, period, horizon, arrival, stride = timing
    for g, (path, heading, last) in enumerate(zip(positions, yaws, lengths), row):
        number, t, times = 0, phase, out.times[g]
        while t < last:
            times[number], number, t = t, number + 1, t + period
        if arrival:
            times[number], number = last, number + 1
            t += period if t == last else 0
        out.own[g] = number
        while t <= horizon:
            times[number], number, t = t, number + 1, t + period
        out.number[g] = number
        for i in range(number):
            # At the end, or a multiple of the stride.
            k = (min(times[i], last) + stride - 1) // stride
            out.yaws[g, i] = heading[k]
            for axis in range(dimension):
                out.positions[g, i, axis] = path[k, axis]


def predicted(
    robots: Sequence[Paths], horizon: int, extend: bool, sight: Sight = CLEAR
) -> Measurements:
    """Return the measurements of robots on their trajectories.

    With `extend` robots continue to measure at their ends until `horizon` (000, section 6: appended
    constant states), which counts only for others.
    """
    counts = [len(paths.lengths) for paths in robots]
    total, most = sum(counts), 1
    for paths in robots:
        longest = max(horizon, int(paths.lengths.max(initial=0)))
        most = max(most, max(0, longest - paths.phase) // paths.view.period_steps + 2)
    detections = [paths.view.sensor.detection for paths in robots]
    out = Measurements(
        np.repeat(np.arange(len(robots)), counts),
        number=np.empty(total, np.int64),
        own=np.empty(total, np.int64),
        times=np.full((total, most), NEVER),
        positions=np.zeros((total, most, 3)),
        yaws=np.zeros((total, most)),
        kind=np.array([item.kernel()[0] for item in detections], np.int64),
        parameters=np.array([item.kernel()[1] for item in detections]).reshape(-1, PARAMETERS),
        reach=np.array([reach_of(item) for item in detections], float),
        layer=np.array([layer_of(sight, paths.view.height) for paths in robots], np.int64),
        sight=sight,
    )
    row = 0
    for paths, count in zip(robots, counts):
        until, period = horizon if extend else -1, paths.view.period_steps
        timing = paths.phase, period, until, paths.arrival, paths.stride
        dimension = paths.view.sensor.dimension
        _fill(out, row, paths.positions, paths.yaws, paths.lengths, timing, dimension)
        row += count
    return out


def reach_of(detection: DetectionModel) -> float:
    """Return the horizontal distance beyond which pi is 0 [m], or inf."""
    kind, parameters = detection.kernel()
    if kind == CUSTOM:
        return float(parameters[REACH])
    if kind != BOX:
        return math.inf
    x, y, z = np.maximum(np.abs(parameters[1:4]), np.abs(parameters[4:7])).tolist()
    return max(math.hypot(x, y), z if math.isfinite(z) else 0.0) + 2.0 * float(parameters[7])


def part_of(measured: Measurements, begin: int, end: int) -> Measurements:
    """Return the measurements on the trajectories from `begin` to before `end`."""
    own = ('robot', 'number', 'own', 'times', 'positions', 'yaws')
    return measured._replace(**{name: getattr(measured, name)[begin:end] for name in own})


def parts_of(measured: Measurements, points: int) -> Iterator[tuple[slice, Measurements]]:
    """Yield parts of the trajectories, for each of which `chances` needs little memory."""
    total, each = len(measured.own), measured.times.shape[1] * max(1, points)
    number = max(1, MOST_CHANCES // each)
    for begin in range(0, total, number):
        yield slice(begin, begin + number), part_of(measured, begin, begin + number)


@njit(cache=True)
def chances(measured: Measurements, first: int, points: FloatArray) -> FloatArray:
    """Return pi at points (C, 3) of the planned measurements from `first` on, (G, n, C)."""
    number, surface = points.shape[0], measured.sight.surface
    out = np.zeros((measured.own.shape[0], measured.times.shape[1], number))
    x, y, z = np.empty((3, number))
    for g in range(out.shape[0]):
        robot = measured.robot[g]
        kind, parameters = measured.kind[robot], measured.parameters[robot]
        for e in range(first, measured.own[g]):
            for c in range(number):
                x[c] = points[c, 0] - measured.positions[g, e, 0]
                y[c] = points[c, 1] - measured.positions[g, e, 1]
                z[c] = points[c, 2] - measured.positions[g, e, 2]
            cosine, sine = math.cos(measured.yaws[g, e]), math.sin(measured.yaws[g, e])
            fill_probabilities(kind, parameters, x, y, z, cosine, sine, out[g, e])
            if surface.heights.size == 0:
                continue
            height = measured.sight.heights[measured.layer[robot]]
            at_x, at_y = measured.positions[g, e, 0], measured.positions[g, e, 1]
            for c in range(number):
                if out[g, e, c] > 0.0 and hides(
                    surface, at_x, at_y, height, points[c, 0], points[c, 1]
                ):
                    out[g, e, c] = 0.0
    return out


@njit(cache=True, error_model='numpy')
def chance_in_sight(
    measured: Measurements, g: int, e: int, x: float, y: float, cosine: float, sine: float
) -> float:
    """Return pi over terrain at x, y of measurement e of trajectory g, whose heading is given.

    0 if it is negligible.
    """
    robot, (x0, y0, _) = measured.robot[g], measured.positions[g, e]
    parameters = measured.parameters[robot]
    chance = detection_probability_at(
        measured.kind[robot], parameters, x - x0, y - y0, 0.0, cosine, sine
    )
    if chance <= NEGLIGIBLE * parameters[0]:
        return 0.0
    return 0.0 if is_hidden(measured.sight, measured.layer[robot], x0, y0, x, y) else chance


@njit(cache=True)
def apply_misses(
    positions: Axes,
    until: IntArray,
    left: FloatArray,
    measured: Measurements,
    g: int,
    first: int,
    last: int,
) -> None:
    """Multiply left (n,) at positions by 1 - pi of measurements of trajectory g.

    At a position, measurements from `first` to before `last` count until its time in `until` (n,),
    which does not decrease.
    """
    robot = measured.robot[g]
    kind, parameters = measured.kind[robot], measured.parameters[robot]
    reach = measured.reach[robot]
    number, begin = left.shape[0], 0
    scratch = np.empty((4, number))
    # The heading counts only for boxes and plugins.
    cosine, sine = 1.0, 0.0
    for e in range(first, last):
        while begin < number and until[begin] < measured.times[g, e]:
            begin += 1
        if begin == number:
            return
        x0, y0, z0 = measured.positions[g, e]
        if kind >= BOX:
            cosine, sine = math.cos(measured.yaws[g, e]), math.sin(measured.yaws[g, e])
        if measured.sight.surface.heights.size > 0:
            for i in range(begin, number):
                if left[i] > 0.0:
                    left[i] *= 1.0 - chance_in_sight(
                        measured, g, e, positions[0][i], positions[1][i], cosine, sine
                    )
            continue
        if reach < np.inf:
            for i in range(begin, number):
                dx, dy = positions[0][i] - x0, positions[1][i] - y0
                if left[i] > 0.0 and abs(dx) <= reach and abs(dy) <= reach:
                    left[i] *= 1.0 - detection_probability_at(
                        kind, parameters, dx, dy, positions[2][i] - z0, cosine, sine
                    )
            continue
        # Slices, as possibly negative indices prevent vectorised loops.
        width = number - begin
        x, y, z, chance = (
            scratch[0, :width],
            scratch[1, :width],
            scratch[2, :width],
            scratch[3, :width],
        )
        px, py, pz, after = (
            positions[0][begin:],
            positions[1][begin:],
            positions[2][begin:],
            left[begin:],
        )
        for i in range(width):
            x[i] = px[i] - x0
            y[i] = py[i] - y0
            z[i] = pz[i] - z0
        fill_probabilities(kind, parameters, x, y, z, cosine, sine, chance)
        for i in range(width):
            after[i] *= 1.0 - chance[i]
