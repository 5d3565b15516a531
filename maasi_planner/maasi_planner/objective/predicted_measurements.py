"""Predicted measurements along trajectories, and what they leave unseen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
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
from maasi_planner.team import RobotView

# After every measurement [steps].
NEVER = 1 << 60


class Measurements(NamedTuple):
    """Predicted measurements of R robots, one trajectory after the other, in order of time.

    Trajectory w has start[w] to start[w + 1], of which the first own[w] are planned and the others
    only expected by other robots, and is of robot[w]. times (n,) [steps from now], places (n, 3)
    [m], in 2D with z = 0, turns (n, 2) cosine and sine of the heading. Of each robot the kernel of
    pi, kind (R,) and parameters (R, PARAMETERS), and its reach (R,), beyond which pi is 0 [m].
    """

    start: IntArray
    own: IntArray
    robot: IntArray
    times: IntArray
    places: FloatArray
    turns: FloatArray
    kind: IntArray
    parameters: FloatArray
    reach: FloatArray


class Timing(NamedTuple):
    """When a robot measures on a trajectory.

    First after `phase` steps, then every `period` steps, and with `arrival` at the end; with
    `extend` it continues there until `horizon` (000, section 6: appended constant states), which
    others see in e but it does not count for itself.
    """

    phase: int
    period: int
    horizon: int
    arrival: bool
    extend: bool


@njit(cache=True)
def _fill(
    positions: FloatArray, yaws: FloatArray, lengths: IntArray, timing: Timing, out: Measurements
) -> None:
    number = 0
    for w in range(positions.shape[0]):
        length = lengths[w]
        out.start[w] = number
        t = timing.phase
        while t < length:
            out.times[number] = t
            number += 1
            t += timing.period
        if timing.arrival:
            out.times[number] = length
            number += 1
            if t == length:
                t += timing.period
        out.own[w] = number - out.start[w]
        while timing.extend and t <= timing.horizon:
            out.times[number] = t
            number += 1
            t += timing.period
        for i in range(out.start[w], number):
            k = min(out.times[i], length)
            for axis in range(3):
                out.places[i, axis] = positions[w, k, axis]
            out.turns[i, 0] = math.cos(yaws[w, k])
            out.turns[i, 1] = math.sin(yaws[w, k])
    out.start[-1] = number


def predicted(
    positions: FloatArray, yaws: FloatArray, lengths: IntArray, timing: Timing, view: RobotView
) -> Measurements:
    """Return the measurements of a robot along trajectories (W, K + 1, 3) [m]."""
    number = len(positions)
    longest = max(timing.horizon, int(lengths.max(initial=0)))
    most = number * (max(0, longest - timing.phase) // timing.period + 3)
    detection = view.sensor.detection
    kind, parameters = detection.kernel()
    out = Measurements(
        start=np.zeros(number + 1, np.int64),
        own=np.zeros(number, np.int64),
        robot=np.zeros(number, np.int64),
        times=np.empty(most, np.int64),
        places=np.empty((most, 3)),
        turns=np.empty((most, 2)),
        kind=np.array([kind]),
        parameters=parameters[None, :],
        reach=np.array([reach_of(detection)]),
    )
    _fill(positions, yaws, lengths, timing, out)
    filled = slice(int(out.start[-1]))
    if view.sensor.dimension == 2:
        out.places[:, 2] = 0.0
    return out._replace(times=out.times[filled], places=out.places[filled], turns=out.turns[filled])


def of_candidates(
    ways: Trajectories, view: RobotView, horizon: int, arrival: bool, extend: bool
) -> Measurements:
    """Return the measurements of a robot that plans, on the way to each candidate."""
    timing = Timing(0, view.period_steps, horizon, arrival, extend)
    return predicted(ways.positions, ways.yaws, ways.lengths, timing, view)


def of_remaining_path(view: RobotView, horizon: int, extend: bool) -> Measurements:
    """Return the measurements of a robot that does not plan."""
    path, yaws = view.remaining_path, view.remaining_yaws
    if path is None or len(path) == 0:
        path, yaws = np.array(view.state.pose.position)[None, :], None
    if yaws is None:
        yaws = np.full(len(path), view.state.pose.yaw)
    # Where its path ends the robot measures in any case: it plans there.
    timing = Timing(max(0, view.phase), view.period_steps, horizon, len(path) > 1, extend)
    positions, yaws = np.ascontiguousarray(path, float), np.ascontiguousarray(yaws, float)
    lengths = np.array([len(path) - 1], np.int64)
    return predicted(positions[None], yaws[None], lengths, timing, view)


def first_of_each(measured: Measurements) -> Measurements:
    """Return of each robot the first planned measurement of its first trajectory, if any."""
    _, chosen = np.unique(measured.robot, return_index=True)
    chosen = chosen[measured.own[chosen] > 0]
    rows = measured.start[chosen]
    return measured._replace(
        start=np.arange(len(rows) + 1),
        own=np.ones(len(rows), np.int64),
        robot=measured.robot[chosen],
        times=measured.times[rows],
        places=measured.places[rows],
        turns=measured.turns[rows],
    )


# Of no robot.
NONE = Measurements(
    start=np.zeros(1, np.int64),
    own=np.zeros(0, np.int64),
    robot=np.zeros(0, np.int64),
    times=np.zeros(0, np.int64),
    places=np.zeros((0, 3)),
    turns=np.zeros((0, 2)),
    kind=np.zeros(0, np.int64),
    parameters=np.zeros((0, PARAMETERS)),
    reach=np.zeros(0),
)


def joined(parts: Sequence[Measurements]) -> Measurements:
    """Return the measurements of several robots as one."""
    if len(parts) == 1:
        return parts[0]
    whole = [np.concatenate(column) for column in zip(NONE, *parts)]
    before = np.cumsum([0, *(len(part.times) for part in parts)])
    start = [part.start[1:] + offset for part, offset in zip(parts, before)]
    robots = np.cumsum([0, *(len(part.kind) for part in parts)])
    robot = [part.robot + offset for part, offset in zip(parts, robots)]
    return Measurements(*whole)._replace(
        start=np.concatenate([NONE.start, *start]), robot=np.concatenate([NONE.robot, *robot])
    )


def reach_of(detection: DetectionModel) -> float:
    """Return the horizontal distance beyond which pi is 0, metres; inf if there is none."""
    kind, parameters = detection.kernel()
    if kind == CUSTOM:
        return float(parameters[REACH])
    if kind != BOX:
        return math.inf
    offsets = np.abs(parameters[[1, 2, 4, 5]])
    extra = np.abs(parameters[[3, 6]])
    extra = extra[np.isfinite(extra)]
    reach = math.hypot(float(offsets[[0, 2]].max()), float(offsets[[1, 3]].max()))
    return max([reach, *extra.tolist()]) + 2.0 * float(parameters[7])


@njit(cache=True)
def apply_misses(
    places: FloatArray,
    until: IntArray,
    left: FloatArray,
    measured: Measurements,
    w: int,
    first: int,
    last: int,
) -> None:
    """Multiply left (n,) at places (3, n) by 1 - pi of measurements of trajectory w.

    At a place those from `first` to before `last` count that are taken by its time in `until` (n,),
    which does not decrease.
    """
    robot = measured.robot[w]
    kind, parameters = measured.kind[robot], measured.parameters[robot]
    reach = measured.reach[robot]
    number = left.shape[0]
    room = np.empty((4, number))
    begin = 0
    for e in range(measured.start[w] + first, measured.start[w] + last):
        while begin < number and until[begin] < measured.times[e]:
            begin += 1
        if begin == number:
            return
        x0, y0, z0 = measured.places[e]
        cosine, sine = measured.turns[e]
        if reach < np.inf:
            for i in range(begin, number):
                dx, dy = places[0, i] - x0, places[1, i] - y0
                if left[i] > 0.0 and abs(dx) <= reach and abs(dy) <= reach:
                    left[i] *= 1.0 - detection_probability_at(
                        kind, parameters, dx, dy, places[2, i] - z0, cosine, sine
                    )
            continue
        # Slices: an index that might be negative keeps loops from becoming vector instructions.
        width = number - begin
        x, y, z, chance = room[0, :width], room[1, :width], room[2, :width], room[3, :width]
        px, py, pz, after = places[0, begin:], places[1, begin:], places[2, begin:], left[begin:]
        for i in range(width):
            x[i] = px[i] - x0
            y[i] = py[i] - y0
            z[i] = pz[i] - z0
        fill_probabilities(kind, parameters, x, y, z, width, cosine, sine, chance)
        for i in range(width):
            after[i] *= 1.0 - chance[i]
