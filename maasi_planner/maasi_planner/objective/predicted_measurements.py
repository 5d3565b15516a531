"""Predicted measurements along trajectories: when, where, and in which direction."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.models.custom_kernel import CUSTOM, REACH
from maasi_filter.models.detection import BOX
from maasi_planner.team import RobotView

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


# Kind and parameters of a probability of detection pi.
Kernel = tuple[int, FloatArray]


class Measurements(NamedTuple):
    """Measurements in order of time.

    times (n,) [steps from now], places (n, 3) [m], turns (n, 2): cosine and sine of the heading.
    """

    times: IntArray
    places: FloatArray
    turns: FloatArray


class Events(NamedTuple):
    """Predicted measurements along trajectories, in order of time.

    times (W, H) [steps from now], places (W, H, 3), turns (W, H, 2) cosine and sine of the
    heading; of each row the first `own` (W,) are planned, and up to `total` (W,) others expect.
    """

    times: IntArray
    places: FloatArray
    turns: FloatArray
    own: IntArray
    total: IntArray

    def present(self) -> Events:
        """Return the first planned measurement of the first trajectory, if there is any."""
        own = np.minimum(self.own[:1], 1)
        return Events(self.times[:1], self.places[:1], self.turns[:1], own, self.total[:1])

    def expected(self) -> Measurements:
        """Return the measurements that others expect on the first trajectory."""
        total = int(self.total[0])
        return Measurements(self.times[0, :total], self.places[0, :total], self.turns[0, :total])


class Timing(NamedTuple):
    """When a robot measures on a trajectory.

    Attributes
    ----------
    phase, period : int
        Steps to the first measurement and between measurements.
    horizon : int
        Last step of interest.
    arrival : bool
        Whether the measurement on arrival belongs to the trajectory, too.
    extend : bool
        Whether a robot keeps measuring where its trajectory ends (000, section 6: appended
        constant states), which others see in e but which it does not count for itself.
    """

    phase: int
    period: int
    horizon: int
    arrival: bool
    extend: bool


@njit(cache=True)
def _fill_events(
    positions: FloatArray, yaws: FloatArray, lengths: IntArray, timing: Timing, out: Events
) -> None:
    times, places, turns = out.times, out.places, out.turns
    for w in range(positions.shape[0]):
        length = lengths[w]
        number = 0
        t = timing.phase
        while t < length:
            times[w, number] = t
            number += 1
            t += timing.period
        if timing.arrival:
            times[w, number] = length
            number += 1
            if t == length:
                t += timing.period
        out.own[w] = number
        if timing.extend:
            while t <= timing.horizon:
                times[w, number] = t
                number += 1
                t += timing.period
        out.total[w] = number
        last_yaw = 0.0
        cosine = 1.0
        sine = 0.0
        for i in range(number):
            k = min(times[w, i], length)
            for axis in range(3):
                places[w, i, axis] = positions[w, k, axis]
            if yaws[w, k] != last_yaw:
                last_yaw = yaws[w, k]
                cosine = math.cos(last_yaw)
                sine = math.sin(last_yaw)
            turns[w, i, 0] = cosine
            turns[w, i, 1] = sine


def events(positions: FloatArray, yaws: FloatArray, lengths: IntArray, timing: Timing) -> Events:
    """Return the predicted measurements along trajectories.

    Parameters
    ----------
    positions, yaws : (W, K + 1, 3), (W, K + 1) arrays
        Trajectories, metres and radians.
    lengths : (W,) array
        Their lengths in steps.
    timing : Timing
        When the robot measures.
    """
    number = len(positions)
    longest = max(timing.horizon, int(lengths.max(initial=0)))
    slots = max(0, longest - timing.phase) // timing.period + 3
    out = Events(
        np.zeros((number, slots), np.int64),
        np.zeros((number, slots, 3)),
        np.zeros((number, slots, 2)),
        np.zeros(number, np.int64),
        np.zeros(number, np.int64),
    )
    _fill_events(positions, yaws, lengths, timing, out)
    return out


def reach_of(kind: int, parameters: FloatArray) -> float:
    """Return the horizontal distance beyond which pi is 0, metres; inf if there is none."""
    if kind == CUSTOM:
        return float(parameters[REACH])
    if kind != BOX:
        return math.inf
    offsets = np.abs(parameters[[1, 2, 4, 5]])
    extra = np.abs(parameters[[3, 6]])
    extra = extra[np.isfinite(extra)]
    reach = math.hypot(float(offsets[[0, 2]].max()), float(offsets[[1, 3]].max()))
    return max([reach, *extra.tolist()]) + 2.0 * float(parameters[7])


def path_events(view: RobotView, horizon: int, extend: bool) -> Events:
    """Return the predicted measurements of a robot that is not planning."""
    path = view.remaining_path
    if path is None or len(path) == 0:
        positions = np.array(view.state.pose.position)[None, None, :]
    else:
        positions = np.ascontiguousarray(path, dtype=float)[None, :, :]
    if path is not None and view.remaining_yaws is not None and len(path):
        yaws = np.ascontiguousarray(view.remaining_yaws, dtype=float)[None, :]
    else:
        yaws = np.full(positions.shape[:2], view.state.pose.yaw)
    lengths = np.array([positions.shape[1] - 1], np.int64)
    # Where its path ends the robot measures in any case: it plans there.
    arrival = path is not None and len(path) > 1
    timing = Timing(max(0, view.phase), view.period_steps, horizon, arrival, extend)
    return events(positions, yaws, lengths, timing)


def rows_of(planned: list[Events]) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return the events of all candidates one after the other."""
    totals = joined([item.total for item in planned], np.int64)
    start = starts_of(totals)
    keep = [np.arange(item.times.shape[1])[None, :] < item.total[:, None] for item in planned]
    return (
        start,
        joined([item.times[mask] for item, mask in zip(planned, keep)], np.int64),
        stacked([item.places[mask] for item, mask in zip(planned, keep)], 3),
        stacked([item.turns[mask] for item, mask in zip(planned, keep)], 2),
    )


def starts_of(counts: IntArray) -> IntArray:
    """Return where each of several parts begins, one after the other, and where the last ends."""
    # Faster than NumPy's cumulative sum for the few parts.
    return np.array([0, *accumulate(counts.tolist())], np.int64)


def joined(parts: list, dtype: type) -> NDArray:
    """Return arrays as one, of `dtype`."""
    if len(parts) == 1:
        return np.ascontiguousarray(parts[0], dtype)
    return np.concatenate(parts).astype(dtype, copy=False) if parts else np.zeros(0, dtype)


def stacked(parts: list, width: int) -> FloatArray:
    """Return the rows of arrays as one array, (0, width) without any."""
    if len(parts) == 1:
        return np.ascontiguousarray(parts[0])
    return np.concatenate(parts) if parts else np.zeros((0, width))
