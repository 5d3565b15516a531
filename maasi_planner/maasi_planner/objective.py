"""The objective J of joint candidates: control cost, target refinement, exploration.

`paper` is 000, eq. (17) to (22) and (26) to (32). e is only needed at the nodes around each
predicted measurement, so the whole grid is never touched; the value is the same.

`information` has T = 1/2 sum_c m_c log det(I + P_c sum pi H' R^-1 H), the information that
measurements give about the clusters, and E = (N0 / V) integral of e (1 - prod(1 - pi)), the
expected number of new targets. Over the robots that plan jointly the terms sum to T and E of all
their measurements together (the union): what two of them see counts once, for the one with the
shorter way (the smaller K; of equals the first by name).

With more than one robot the terms of one depend on the choices of the others. More robots never
make a term larger, so the value of a candidate alone bounds it from above, and the joint search
skips what the bounds rule out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.detection_model import (
    BOX,
    PARAMETERS,
    detection_probability_at,
    fill_probabilities,
)
from maasi_filter.pose import Pose
from maasi_planner.motion.base import Trajectories
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import RobotView, TeamView

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CACHE_ROWS = 8000
# Room for so many offsets at a time: x, y, z and pi.
ROOM = 1024
ROOM_ROWS = 4
# Above this many pairs of a candidate and another robot, values of candidates that were not
# chosen are reported as without the other planning robots.
REPORT_LIMIT = 600
# Moves of two robots at once are tried in teams up to this size.
PAIRS_LIMIT = 5


class Weights(NamedTuple):
    """Settings of the objective with nothing left open."""

    information: bool
    alpha: float
    beta: float
    control: float
    per_distance: bool
    arrival: bool
    present: bool
    own: bool
    extend: bool


def resolve(settings: PlannerSettings) -> Weights:
    """Return the weights that settings mean."""
    information = settings.objective == 'information'

    def given(value: float | None, paper: float, other: float) -> float:
        if value is not None:
            return value
        return other if information else paper

    return Weights(
        information=information,
        alpha=settings.alpha,
        beta=given(settings.beta, 0.5, 1.0),
        control=given(settings.control_weight, 1.0, 1e-6),
        per_distance=settings.normalisation == 'distance',
        arrival=bool(given(settings.measure_at_arrival, False, True)),
        present=bool(given(settings.count_present, True, False)),
        own=settings.own_measurement is not False,
        extend=settings.extension == 'measuring',
    )


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


@njit(cache=True)
def _fill_events(
    positions: FloatArray,
    yaws: FloatArray,
    lengths: IntArray,
    phase: int,
    period: int,
    horizon: int,
    arrival: bool,
    extend: bool,
    times: IntArray,
    places: FloatArray,
    turns: FloatArray,
    own: IntArray,
    total: IntArray,
) -> None:  # pragma: no cover - compiled
    for w in range(positions.shape[0]):
        length = lengths[w]
        number = 0
        t = phase
        while t < length:
            times[w, number] = t
            number += 1
            t += period
        if arrival:
            times[w, number] = length
            number += 1
            if t == length:
                t += period
        own[w] = number
        if extend:
            while t <= horizon:
                times[w, number] = t
                number += 1
                t += period
        total[w] = number
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


def events(
    positions: FloatArray,
    yaws: FloatArray,
    lengths: IntArray,
    phase: int,
    period: int,
    horizon: int,
    arrival: bool,
    extend: bool,
) -> Events:
    """Return the predicted measurements along trajectories.

    Parameters
    ----------
    positions, yaws : (W, K + 1, 3), (W, K + 1) arrays
        Trajectories, metres and radians.
    lengths : (W,) array
        Their lengths in steps.
    phase, period : int
        Steps to the first measurement and between measurements.
    horizon : int
        Last step of interest.
    arrival : bool
        Whether the measurement on arrival belongs to the trajectory, too.
    extend : bool
        Whether a robot goes on measuring where its trajectory ends (000, section 6: appended
        constant states), which others see in e but which it does not count for itself.
    """
    number = len(positions)
    longest = max(horizon, int(lengths.max(initial=0)))
    slots = max(0, longest - phase) // period + 3
    out = Events(
        np.zeros((number, slots), np.int64),
        np.zeros((number, slots, 3)),
        np.zeros((number, slots, 2)),
        np.zeros(number, np.int64),
        np.zeros(number, np.int64),
    )
    _fill_events(
        positions,
        yaws,
        lengths,
        phase,
        period,
        horizon,
        arrival,
        extend,
        out.times,
        out.places,
        out.turns,
        out.own,
        out.total,
    )
    return out


def _first_row(item: Events) -> Events:
    """Return the events of the first trajectory."""
    return Events(item.times[:1], item.places[:1], item.turns[:1], item.own[:1], item.total[:1])


class Joint(NamedTuple):
    """Everything about the planning robots that the joint search needs.

    G candidates of R robots, one robot after the other; robot r has start[r] to start[r + 1].
    """

    start: IntArray
    robot: IntArray
    allowed: BoolArray
    waypoints: FloatArray
    radii: FloatArray
    control: FloatArray
    norm: FloatArray
    alpha: float
    beta: float
    control_weight: float
    information: bool
    dimension: int
    refinement: FloatArray  # T of paper, (G,)
    # Predicted measurements, for e that others see: rows of events.
    event_start: IntArray
    event_time: IntArray
    event_place: FloatArray
    event_turn: FloatArray
    kind: IntArray
    parameters: FloatArray
    # Interpolation nodes of a candidate's own measurements.
    entry_start: IntArray
    entry_value: FloatArray
    entry_node: FloatArray
    entry_time: IntArray
    # What one candidate's measurements leave of another one's entries: slot (G, G) is a row of
    # cache (S, longest), filled when first asked for; used (1,) counts the rows in use.
    slot: NDArray[np.int32]
    cache: FloatArray
    used: IntArray
    # Information about clusters.
    mass: FloatArray
    covariance: FloatArray
    base: FloatArray
    gain: FloatArray
    # Expected new targets.
    unseen: FloatArray
    miss: FloatArray


@njit(cache=True)
def _together(kind: int) -> bool:  # pragma: no cover - compiled
    """Return whether pi does not depend on the heading and is nowhere 0, so that many at a time
    are quicker than one by one with an early end.
    """
    return kind != BOX


@njit(cache=True)
def _fill(
    kind: int, parameters: FloatArray, number: int, room: FloatArray
) -> FloatArray:  # pragma: no cover - compiled
    """Return pi at the first `number` offsets in room (rows x, y, z and one more)."""
    fill_probabilities(kind, parameters, room[0], room[1], room[2], number, 1.0, 0.0, room[3])
    return room[3]


@njit(cache=True)
def _see(
    nodes: FloatArray,
    until: IntArray,
    margin: int,
    times: IntArray,
    places: FloatArray,
    turns: FloatArray,
    dimension: int,
    kind: int,
    parameters: FloatArray,
    values: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Multiply values at nodes (n, 3) by what a row of measurements leaves there.

    Of the measurements those count that are at least `margin` steps before `until` (n,); neither
    these times nor those of the measurements decrease.
    """
    number = nodes.shape[0]
    if not _together(kind):
        for i in range(number):
            left = values[i]
            for e in range(times.shape[0]):
                if times[e] + margin > until[i] or left <= 0.0:
                    break
                left *= 1.0 - detection_probability_at(
                    kind,
                    parameters,
                    nodes[i, 0] - places[e, 0],
                    nodes[i, 1] - places[e, 1],
                    (nodes[i, 2] - places[e, 2]) if dimension == 3 else 0.0,
                    turns[e, 0],
                    turns[e, 1],
                )
            values[i] = left
        return
    # Many at a time: as much as there is room for.
    room = np.empty((ROOM_ROWS, max(ROOM, number)))
    first = np.empty(times.shape[0], np.int64)
    begin = 0
    filled = 0
    done = 0
    for e in range(times.shape[0] + 1):
        width = 0
        if e < times.shape[0]:
            while begin < number and until[begin] < times[e] + margin:
                begin += 1
            width = number - begin
        if width == 0 or filled + width > room.shape[1]:
            chances = _fill(kind, parameters, filled, room)
            for b in range(done, e):
                later = values[first[b] :]
                for i in range(later.shape[0]):
                    later[i] *= 1.0 - chances[i]
                chances = chances[later.shape[0] :]
            done = e
            filled = 0
        if width == 0:
            return
        first[e] = begin
        # Slices: an index that might be negative keeps loops from becoming vector instructions.
        x = room[0, filled : filled + width]
        y = room[1, filled : filled + width]
        z = room[2, filled : filled + width]
        seen = nodes[begin:]
        x0 = places[e, 0]
        y0 = places[e, 1]
        z0 = places[e, 2]
        for i in range(width):
            x[i] = seen[i, 0] - x0
            y[i] = seen[i, 1] - y0
            z[i] = seen[i, 2] - z0 if dimension == 3 else 0.0
        filled += width


@njit(cache=True)
def _centre_sum(
    places: FloatArray,
    turns: FloatArray,
    first: int,
    own: IntArray,
    centres: FloatArray,
    dimension: int,
    kind: int,
    parameters: FloatArray,
    out: FloatArray,
) -> None:  # pragma: no cover - compiled
    together = _together(kind)
    room = np.empty((ROOM_ROWS, places.shape[1] * centres.shape[0]))
    for w in range(places.shape[0]):
        total = 0.0
        number = 0
        for i in range(first, own[w]):
            for c in range(centres.shape[0]):
                dx = centres[c, 0] - places[w, i, 0]
                dy = centres[c, 1] - places[w, i, 1]
                dz = centres[c, 2] - places[w, i, 2] if dimension == 3 else 0.0
                if together:
                    room[0, number] = dx
                    room[1, number] = dy
                    room[2, number] = dz
                    number += 1
                else:
                    total += detection_probability_at(
                        kind, parameters, dx, dy, dz, turns[w, i, 0], turns[w, i, 1]
                    )
        if together:
            chances = _fill(kind, parameters, number, room)
            for i in range(number):
                total += chances[i]
        out[w] = total


@njit(cache=True)
def _own_products(
    shared: IntArray,
    time: IntArray,
    nodes: FloatArray,
    values: FloatArray,
    places: FloatArray,
    margin: int,
    dimension: int,
    kind: int,
    parameters: FloatArray,
    count: IntArray,
    begin: IntArray,
    rank: IntArray,
    work: FloatArray,
    room: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Multiply entries by what a row of measurements leaves at their nodes, in place (21).

    Entry q is of measurement time[q], which does not decrease; those of one node that follow each
    other without a gap have the same number shared[q], so that what is left there is multiplied on.
    Of the measurements at `places` (n, 3) those count that are at least `margin` before an entry's.

    `count` and `begin` (n + 2,), `rank` (8 n,), `work` (4, 8 n) and `room` are scratch.
    """
    entries = shared.shape[0]
    number = places.shape[0]
    unique = 0
    for q in range(entries):
        # The last entry of a node stays.
        rank[shared[q]] = time[q]
        unique = max(unique, shared[q] + 1)
    # Sorted by their last measurement, the nodes that a measurement concerns are one slice.
    count[: number + 2] = 0
    for u in range(unique):
        count[rank[u] + 1] += 1
    for m in range(number):
        count[m + 1] += count[m]
        begin[m] = count[m]
    for u in range(unique):
        last = rank[u]
        rank[u] = count[last]
        count[last] += 1
    x, y, z = work[0, :unique], work[1, :unique], work[2, :unique]
    left = work[3, :unique]
    left[:] = 1.0
    for q in range(entries):
        u = rank[shared[q]]
        x[u] = nodes[q, 0]
        y[u] = nodes[q, 1]
        z[u] = nodes[q, 2]
    done = 0
    filled = 0
    entry = 0
    for e in range(number + 1):
        width = 0
        if e + margin < number:
            width = unique - begin[e + margin]
        if width == 0 or filled + width > room.shape[1]:
            chances = _fill(kind, parameters, filled, room)
            for m in range(done, e):
                later = left[begin[m + margin] :]
                for i in range(later.shape[0]):
                    later[i] *= 1.0 - chances[i]
                chances = chances[later.shape[0] :]
                while entry < entries and time[entry] < m + margin:
                    entry += 1
                while entry < entries and time[entry] == m + margin:
                    values[entry] *= left[rank[shared[entry]]]
                    entry += 1
            done = e
            filled = 0
        if width == 0:
            return
        # Slices: an index that might be negative keeps loops from becoming vector instructions.
        dx = room[0, filled : filled + width]
        dy = room[1, filled : filled + width]
        dz = room[2, filled : filled + width]
        from_x, from_y, from_z = x[unique - width :], y[unique - width :], z[unique - width :]
        x0 = places[e, 0]
        y0 = places[e, 1]
        z0 = places[e, 2]
        for i in range(width):
            dx[i] = from_x[i] - x0
            dy[i] = from_y[i] - y0
            dz[i] = from_z[i] - z0 if dimension == 3 else 0.0
        filled += width


@njit(cache=True, error_model='numpy')
def _cell(position: float, lower: float, step: float, nodes: int) -> tuple[int, float]:
    """Return the cell of a grid's axis that a position is in, and where in it, 0 to 1."""
    u = min(max((position - lower) / step, 0.0), nodes - 1.0)
    cell = min(np.int64(u), nodes - 2)
    return cell, u - cell


@njit(cache=True, error_model='numpy')
def _nodes_around(
    w: int,
    begin: int,
    places: FloatArray,
    times: IntArray,
    first: int,
    own: IntArray,
    dimension: int,
    values: FloatArray,
    lower: FloatArray,
    step: FloatArray,
    entry_value: FloatArray,
    entry_node: FloatArray,
    entry_time: IntArray,
    shared: IntArray,
    measurement: IntArray,
    before: IntArray,
) -> int:  # pragma: no cover - compiled
    """Fill the nodes around the measurements of a trajectory: weight times e, if above 0.

    `shared` and `measurement` are as in `_own_products`, `before` (2, 8) is scratch. Return how
    many there are.
    """
    number = 0
    unique = 0
    depth = 2 if dimension == 3 else 1
    before[:] = -1
    ci, cj, ck = np.int64(-9), np.int64(-9), np.int64(0)
    for m in range(first, own[w]):
        pi, pj, pk = ci, cj, ck
        fz = 0.0
        ci, fx = _cell(places[w, m, 0], lower[0], step[0], values.shape[0])
        cj, fy = _cell(places[w, m, 1], lower[1], step[1], values.shape[1])
        if depth == 2:
            ck, fz = _cell(places[w, m, 2], lower[2], step[2], values.shape[2])
        time = times[w, m]
        now = m & 1
        for i in range(2):
            x = lower[0] + (ci + i) * step[0]
            wx = fx if i else 1.0 - fx
            for j in range(2):
                y = lower[1] + (cj + j) * step[1]
                wy = wx * (fy if j else 1.0 - fy)
                for k in range(depth):
                    weight = wy * (fz if k else 1.0 - fz) * values[ci + i, cj + j, ck + k]
                    corner = 4 * i + 2 * j + k
                    before[now, corner] = -1
                    if not weight > 0.0:
                        continue
                    # The corner of the place before that is the same node, if any; without
                    # branches, as none could be foretold.
                    a, b, c = i + ci - pi, j + cj - pj, k + ck - pk
                    known = before[1 - now, (4 * a + 2 * b + c) & 7]
                    new = (((a | b | c) & ~1) != 0) | (known < 0)
                    same = unique if new else known
                    unique += 1 if new else 0
                    before[now, corner] = same
                    shared[number] = same
                    measurement[number] = m
                    entry_value[begin + number] = weight
                    entry_node[begin + number, 0] = x
                    entry_node[begin + number, 1] = y
                    entry_node[begin + number, 2] = lower[2] + (ck + k) * step[2]
                    entry_time[begin + number] = time
                    number += 1
    return number


@njit(cache=True)
def _entries(
    times: IntArray,
    places: FloatArray,
    turns: FloatArray,
    first: int,
    own: IntArray,
    own_counts: bool,
    dimension: int,
    kind: int,
    parameters: FloatArray,
    values: FloatArray,
    lower: FloatArray,
    step: FloatArray,
    entry_count: IntArray,
    entry_value: FloatArray,
    entry_node: FloatArray,
    entry_time: IntArray,
) -> int:  # pragma: no cover - compiled
    """Fill the nodes of (22): weight times e times the robot's own product (21), if above 0."""
    most = 0
    for w in range(places.shape[0]):
        most = max(most, own[w])
    size = (4 if dimension == 2 else 8) * most
    shared = np.empty(size, np.int64)
    measurement = np.empty(size, np.int64)
    before = np.empty((2, 8), np.int64)
    together = _together(kind)
    number = 0
    if together:
        rank = np.empty(size, np.int64)
        count = np.empty(most + 2, np.int64)
        begin_at = np.empty(most + 2, np.int64)
        work = np.empty((4, size))
        room = np.empty((ROOM_ROWS, max(ROOM, size)))
    for w in range(places.shape[0]):
        begin = number
        found = _nodes_around(
            w,
            begin,
            places,
            times,
            first,
            own,
            dimension,
            values,
            lower,
            step,
            entry_value,
            entry_node,
            entry_time,
            shared,
            measurement,
            before,
        )
        if together:
            number += found
            entry_count[w] = found
            if found:
                _own_products(
                    shared[:found],
                    measurement[:found],
                    entry_node[begin:number],
                    entry_value[begin:number],
                    places[w, : own[w]],
                    0 if own_counts else 1,
                    dimension,
                    kind,
                    parameters,
                    count,
                    begin_at,
                    rank,
                    work,
                    room,
                )
            continue
        # What is seen already is left out, in place.
        for q in range(begin, begin + found):
            m = measurement[q - begin]
            left = entry_value[q]
            e = m if own_counts else m - 1
            # The latest first: with a sharp view it ends the product at once.
            while e >= 0 and left > 0.0:
                left *= 1.0 - detection_probability_at(
                    kind,
                    parameters,
                    entry_node[q, 0] - places[w, e, 0],
                    entry_node[q, 1] - places[w, e, 1],
                    (entry_node[q, 2] - places[w, e, 2]) if dimension == 3 else 0.0,
                    turns[w, e, 0],
                    turns[w, e, 1],
                )
                e -= 1
            if left > 0.0:
                entry_value[number] = left
                entry_node[number] = entry_node[q]
                entry_time[number] = entry_time[q]
                number += 1
        entry_count[w] = number - begin
    return number


@njit(cache=True)
def _information(
    matrices: FloatArray,
    probabilities: FloatArray,
    first: int,
    own: IntArray,
    out: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Sum pi H' R^-1 H over measurements: matrices (W, H, C, d, d) into out (W, C, d, d)."""
    d = matrices.shape[3]
    for w in range(matrices.shape[0]):
        for i in range(first, own[w]):
            for c in range(matrices.shape[2]):
                p = probabilities[w, i, c]
                if p > 0.0:
                    for a in range(d):
                        for b in range(d):
                            out[w, c, a, b] += p * matrices[w, i, c, a, b]


@njit(cache=True)
def _miss_at_nodes(
    places: FloatArray,
    turns: FloatArray,
    first: int,
    own: IntArray,
    axes_start: FloatArray,
    axes_step: FloatArray,
    index: IntArray,
    dimension: int,
    kind: int,
    parameters: FloatArray,
    reach: float,
    miss: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Multiply `miss` (W, L) by 1 - pi of each measurement at the nodes.

    `index` (nx, ny, nz) is the column of a node, or -1 where nothing is left to see; only nodes
    within `reach` of a measurement are visited.
    """
    low = np.zeros(3, np.int64)
    high = np.zeros(3, np.int64)
    for w in range(places.shape[0]):
        for m in range(first, own[w]):
            for axis in range(3):
                low[axis] = 0
                high[axis] = index.shape[axis]
                if axis < dimension and reach < np.inf and axes_step[axis] > 0.0:
                    centre = (places[w, m, axis] - axes_start[axis]) / axes_step[axis]
                    width = reach / axes_step[axis]
                    low[axis] = min(max(math.floor(centre - width), 0), high[axis])
                    high[axis] = max(min(math.ceil(centre + width) + 1, high[axis]), 0)
            for i in range(low[0], high[0]):
                dx = axes_start[0] + i * axes_step[0] - places[w, m, 0]
                for j in range(low[1], high[1]):
                    dy = axes_start[1] + j * axes_step[1] - places[w, m, 1]
                    for k in range(low[2], high[2]):
                        column = index[i, j, k]
                        if column < 0:
                            continue
                        dz = 0.0
                        if dimension == 3:
                            dz = axes_start[2] + k * axes_step[2] - places[w, m, 2]
                        miss[w, column] *= 1.0 - detection_probability_at(
                            kind, parameters, dx, dy, dz, turns[w, m, 0], turns[w, m, 1]
                        )


@njit(cache=True)
def _blocks(
    values: FloatArray, volumes: FloatArray, stride: int, out: FloatArray
) -> None:  # pragma: no cover - compiled
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            for k in range(values.shape[2]):
                out[i // stride, j // stride, k // stride] += values[i, j, k] * volumes[i, j, k]


@njit(cache=True)
def _log_det(matrix: FloatArray) -> float:  # pragma: no cover - compiled
    """Return log det of a (2, 2) or (3, 3) matrix with determinant of at least 1."""
    if matrix.shape[0] == 2:
        det = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    else:
        det = (
            matrix[0, 0] * (matrix[1, 1] * matrix[2, 2] - matrix[1, 2] * matrix[2, 1])
            - matrix[0, 1] * (matrix[1, 0] * matrix[2, 2] - matrix[1, 2] * matrix[2, 0])
            + matrix[0, 2] * (matrix[1, 0] * matrix[2, 1] - matrix[1, 1] * matrix[2, 0])
        )
    return math.log(max(det, 1.0))


@njit(cache=True)
def _credited(joint: Joint, other: int, g: int) -> bool:  # pragma: no cover - compiled
    """Return whether what `other` and g both see counts for `other`: its way is shorter."""
    if joint.norm[other] != joint.norm[g]:
        return joint.norm[other] < joint.norm[g]
    return joint.robot[other] < joint.robot[g]


@njit(cache=True)
def _gain(
    joint: Joint, g: int, chosen: IntArray, work: FloatArray
) -> float:  # pragma: no cover - compiled
    """Return T of `information` for candidate g, given the others with a shorter way."""
    d = joint.dimension
    total = 0.0
    robot = joint.robot[g]
    for c in range(joint.mass.shape[0]):
        helps = False
        for a in range(d):
            if joint.gain[g, c, a, a] > 0.0:
                helps = True
        if not helps:
            continue
        for a in range(d):
            for b in range(d):
                work[0, a, b] = joint.base[c, a, b]
        for r in range(chosen.shape[0]):
            if r != robot and chosen[r] >= 0 and _credited(joint, chosen[r], g):
                for a in range(d):
                    for b in range(d):
                        work[0, a, b] += joint.gain[chosen[r], c, a, b]
        for a in range(d):
            for b in range(d):
                without = 1.0 if a == b else 0.0
                extra = 0.0
                for k in range(d):
                    without += joint.covariance[c, a, k] * work[0, k, b]
                    extra += joint.covariance[c, a, k] * joint.gain[g, c, k, b]
                work[1, a, b] = without
                work[2, a, b] = without + extra
        total += (
            0.5 * joint.mass[c] * max(0.0, _log_det(work[2, :d, :d]) - _log_det(work[1, :d, :d]))
        )
    return total


@njit(cache=True)
def _new_targets(joint: Joint, g: int, chosen: IntArray) -> float:  # pragma: no cover - compiled
    """Return E of `information` for candidate g, given the others with a shorter way."""
    robot = joint.robot[g]
    others = 0
    first = -1
    for r in range(chosen.shape[0]):
        if r != robot and chosen[r] >= 0 and _credited(joint, chosen[r], g):
            others += 1
            first = chosen[r]
    total = 0.0
    if others == 0:
        for node in range(joint.unseen.shape[0]):
            total += joint.unseen[node] * (1.0 - joint.miss[g, node])
    elif others == 1:
        for node in range(joint.unseen.shape[0]):
            seen = 1.0 - joint.miss[g, node]
            if seen > 0.0:
                total += joint.unseen[node] * seen * joint.miss[first, node]
    else:
        for node in range(joint.unseen.shape[0]):
            seen = 1.0 - joint.miss[g, node]
            if seen > 0.0:
                left = joint.unseen[node] * seen
                for r in range(chosen.shape[0]):
                    if r != robot and chosen[r] >= 0 and _credited(joint, chosen[r], g):
                        left *= joint.miss[chosen[r], node]
                total += left
    return total


@njit(cache=True)
def _fill_left(
    nodes: FloatArray,
    until: IntArray,
    times: IntArray,
    places: FloatArray,
    turns: FloatArray,
    dimension: int,
    kind: int,
    parameters: FloatArray,
    out: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Write what a row of measurements leaves at each entry, up to the entry's own time."""
    out[:] = 1.0
    _see(nodes, until, 0, times, places, turns, dimension, kind, parameters, out)


@njit(cache=True)
def _fold(
    entry_count: IntArray,
    entry_value: FloatArray,
    entry_node: FloatArray,
    entry_time: IntArray,
    times: IntArray,
    places: FloatArray,
    turns: FloatArray,
    dimension: int,
    kind: int,
    parameters: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Multiply the entries by what a robot whose trajectory is settled will have seen."""
    begin = 0
    for w in range(entry_count.shape[0]):
        end = begin + entry_count[w]
        _see(
            entry_node[begin:end],
            entry_time[begin:end],
            0,
            times,
            places,
            turns,
            dimension,
            kind,
            parameters,
            entry_value[begin:end],
        )
        begin = end


@njit(cache=True)
def _left(joint: Joint, g: int, other: int) -> FloatArray:  # pragma: no cover - compiled
    """Return what the measurements of candidate `other` leave at the entries of g."""
    begin = joint.entry_start[g]
    end = joint.entry_start[g + 1]
    slot = joint.slot[g, other]
    if slot >= 0:
        return joint.cache[slot, : end - begin]
    if joint.used[0] < joint.cache.shape[0]:
        slot = joint.used[0]
        joint.used[0] += 1
        joint.slot[g, other] = slot
        out = joint.cache[slot, : end - begin]
    else:
        out = np.empty(end - begin)
    first = joint.event_start[other]
    last = joint.event_start[other + 1]
    robot = joint.robot[other]
    _fill_left(
        joint.entry_node[begin:end],
        joint.entry_time[begin:end],
        joint.event_time[first:last],
        joint.event_place[first:last],
        joint.event_turn[first:last],
        joint.dimension,
        joint.kind[robot],
        joint.parameters[robot],
        out,
    )
    return out


@njit(cache=True)
def _explored(joint: Joint, g: int, chosen: IntArray) -> float:  # pragma: no cover - compiled
    """Return E of `paper` for candidate g, given the others (31), (32)."""
    robot = joint.robot[g]
    values = joint.entry_value[joint.entry_start[g] : joint.entry_start[g + 1]].copy()
    for r in range(chosen.shape[0]):
        if r != robot and chosen[r] >= 0:
            left = _left(joint, g, chosen[r])
            for i in range(values.shape[0]):
                values[i] *= left[i]
    total = 0.0
    for i in range(values.shape[0]):
        total += values[i]
    return total


@njit(cache=True)
def _weighed(
    control: float,
    refinement: float,
    exploration: float,
    norm: float,
    alpha: float,
    beta: float,
    control_weight: float,
) -> float:  # pragma: no cover - compiled
    """Return J (17), (26) of one candidate."""
    return (-control_weight * control + alpha * refinement + beta * exploration) / norm


@njit(cache=True)
def candidate_value(
    joint: Joint, g: int, chosen: IntArray, work: FloatArray
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Return T, E and J of candidate g, given the others' choices in `chosen` (R,), -1 for none."""
    if joint.information:
        refinement = _gain(joint, g, chosen, work)
        exploration = _new_targets(joint, g, chosen) if joint.beta > 0.0 else 0.0
    else:
        refinement = joint.refinement[g]
        exploration = _explored(joint, g, chosen) if joint.beta > 0.0 else 0.0
    value = _weighed(
        joint.control[g],
        refinement,
        exploration,
        joint.norm[g],
        joint.alpha,
        joint.beta,
        joint.control_weight,
    )
    return refinement, exploration, value


@njit(cache=True)
def collides(joint: Joint, g: int, chosen: IntArray) -> bool:  # pragma: no cover - compiled
    """Return whether the waypoint of g is within the radii of another chosen waypoint."""
    robot = joint.robot[g]
    for r in range(chosen.shape[0]):
        if r == robot or chosen[r] < 0:
            continue
        reach = joint.radii[robot] + joint.radii[r]
        if reach > 0.0:
            square = 0.0
            for axis in range(3):
                square += (joint.waypoints[g, axis] - joint.waypoints[chosen[r], axis]) ** 2
            if square < reach * reach:
                return True
    return False


@njit(cache=True)
def total_value(
    joint: Joint, chosen: IntArray, work: FloatArray
) -> float:  # pragma: no cover - compiled
    """Return the sum of J over all chosen candidates (26)."""
    total = 0.0
    for r in range(chosen.shape[0]):
        if chosen[r] >= 0:
            total += candidate_value(joint, chosen[r], chosen, work)[2]
    return total


@njit(cache=True)
def _alone_on_paper(
    refinement: FloatArray,
    entry_start: IntArray,
    entry_value: FloatArray,
    control: FloatArray,
    norm: FloatArray,
    allowed: BoolArray,
    alpha: float,
    beta: float,
    control_weight: float,
    out: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Do what `alone_values` does for `paper`, without handing over the whole of `Joint`."""
    for g in range(out.shape[0]):
        explored = 0.0
        for i in range(entry_start[g], entry_start[g + 1]):
            explored += entry_value[i]
        out[g, 0] = refinement[g]
        out[g, 1] = explored
        value = _weighed(control[g], refinement[g], explored, norm[g], alpha, beta, control_weight)
        out[g, 2] = value if allowed[g] else -np.inf


@njit(cache=True)
def alone_values(joint: Joint, out: FloatArray) -> None:  # pragma: no cover - compiled
    """Write T, E and J of each candidate without the other planning robots into out (G, 3)."""
    chosen = np.full(joint.radii.shape[0], -1, np.int64)
    work = np.zeros((3, 3, 3))
    for g in range(out.shape[0]):
        refinement, exploration, value = candidate_value(joint, g, chosen, work)
        out[g, 0] = refinement
        out[g, 1] = exploration
        out[g, 2] = value if joint.allowed[g] else -np.inf


@njit(cache=True)
def given_values(
    joint: Joint, robot: int, chosen: IntArray, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Write T, E and J of each candidate of one robot, given the others, into out (W, 3)."""
    work = np.zeros((3, 3, 3))
    for g in range(joint.start[robot], joint.start[robot + 1]):
        refinement, exploration, value = candidate_value(joint, g, chosen, work)
        row = g - joint.start[robot]
        out[row, 0] = refinement
        out[row, 1] = exploration
        out[row, 2] = value if joint.allowed[g] and not collides(joint, g, chosen) else -np.inf


@njit(cache=True)
def search_exactly(
    joint: Joint, alone: FloatArray, order: IntArray, best: IntArray, best_value: float
) -> tuple[float, int]:  # pragma: no cover - compiled
    """Find the best joint choice (26), by depth-first search with bounds.

    Parameters
    ----------
    joint : Joint
        All candidates.
    alone : (G,) array
        J of each candidate alone, an upper bound.
    order : (G,) array
        Candidates of each robot from the best to the worst alone.
    best : (R,) array
        Best choice known; replaced in place. best[0] = -1 if none is known.
    best_value : float
        Its value, or -inf.

    Returns
    -------
    value, evaluated
        Its value, and how many partial joint choices were evaluated.
    """
    robots = joint.radii.shape[0]
    rest = np.zeros(robots + 1)
    for r in range(robots - 1, -1, -1):
        rest[r] = rest[r + 1] + alone[order[joint.start[r]]]
    position = np.zeros(robots, np.int64)
    partial = np.zeros(robots + 1)
    chosen = np.full(robots, -1, np.int64)
    work = np.zeros((3, 3, 3))
    evaluated = 0
    depth = 0
    position[0] = joint.start[0]
    while depth >= 0:
        chosen[depth] = -1
        if position[depth] >= joint.start[depth + 1]:
            depth -= 1
            continue
        g = order[position[depth]]
        position[depth] += 1
        if alone[g] == -np.inf or partial[depth] + alone[g] + rest[depth + 1] <= best_value:
            depth -= 1
            continue
        if collides(joint, g, chosen):
            continue
        chosen[depth] = g
        value = total_value(joint, chosen, work)
        evaluated += 1
        if value + rest[depth + 1] <= best_value:
            continue
        if depth == robots - 1:
            best_value = value
            best[:] = chosen
            continue
        partial[depth + 1] = value
        depth += 1
        position[depth] = joint.start[depth]
    return best_value, evaluated


@njit(cache=True)
def _best_reply(
    joint: Joint,
    robot: int,
    alone: FloatArray,
    order: IntArray,
    chosen: IntArray,
    work: FloatArray,
) -> tuple[int, float, int]:  # pragma: no cover - compiled
    """Return the best candidate of one robot for the team, its total, and the work done."""
    previous = chosen[robot]
    chosen[robot] = -1
    others = total_value(joint, chosen, work)
    best = -1
    best_value = -np.inf
    evaluated = 0
    for i in range(joint.start[robot], joint.start[robot + 1]):
        g = order[i]
        if alone[g] == -np.inf or others + alone[g] <= best_value:
            break
        if collides(joint, g, chosen):
            continue
        chosen[robot] = g
        own = candidate_value(joint, g, chosen, work)[2]
        if others + own > best_value:
            value = total_value(joint, chosen, work)
            if value > best_value:
                best_value = value
                best = g
        chosen[robot] = -1
        evaluated += 1
    chosen[robot] = previous
    return best, best_value, evaluated


@njit(cache=True)
def search_in_turn(
    joint: Joint,
    alone: FloatArray,
    order: IntArray,
    rounds: int,
    backwards: bool,
    chosen: IntArray,
) -> tuple[float, int]:  # pragma: no cover - compiled
    """Let robots choose in turn, each best for the team so far, then improve in rounds.

    A robot that finds no admissible candidate keeps -1 in `chosen` (R,).
    """
    robots = joint.radii.shape[0]
    work = np.zeros((3, 3, 3))
    chosen[:] = -1
    evaluated = 0
    total = -np.inf
    for i in range(robots):
        r = robots - 1 - i if backwards else i
        g, value, count = _best_reply(joint, r, alone, order, chosen, work)
        evaluated += count
        if g >= 0:
            chosen[r] = g
            total = value
    for _ in range(rounds):
        changed = False
        for r in range(robots):
            if chosen[r] < 0:
                continue
            g, value, count = _best_reply(joint, r, alone, order, chosen, work)
            evaluated += count
            if g >= 0 and g != chosen[r] and value > total + 1e-12 * abs(total):
                chosen[r] = g
                total = value
                changed = True
        if not changed:
            break
    return total, evaluated


@njit(cache=True)
def improve_in_pairs(
    joint: Joint,
    alone: FloatArray,
    order: IntArray,
    total: float,
    budget: int,
    chosen: IntArray,
) -> tuple[float, int]:  # pragma: no cover - compiled
    """Improve a choice by moves of two robots at once, while the budget of evaluations lasts.

    One robot takes another candidate, the best alone first, and a second one its best reply.
    """
    robots = joint.radii.shape[0]
    work = np.zeros((3, 3, 3))
    trial = np.zeros(robots, np.int64)
    evaluated = 0
    improved = True
    while improved and evaluated < budget:
        improved = False
        for r in range(robots):
            if chosen[r] < 0:
                continue
            for i in range(joint.start[r], joint.start[r + 1]):
                g = order[i]
                if alone[g] == -np.inf or evaluated >= budget:
                    break
                if g == chosen[r]:
                    continue
                for s in range(robots):
                    if s == r or chosen[s] < 0 or evaluated >= budget:
                        continue
                    trial[:] = chosen
                    trial[s] = -1
                    if collides(joint, g, trial):
                        continue
                    trial[r] = g
                    reply, value, count = _best_reply(joint, s, alone, order, trial, work)
                    evaluated += count + 1
                    if reply >= 0 and value > total + 1e-12 * abs(total):
                        chosen[r] = g
                        chosen[s] = reply
                        total = value
                        improved = True
    return total, evaluated


def kernel_of(view: RobotView) -> tuple[int, FloatArray] | None:
    """Return kind and parameters of a robot's detection model, if it has a kernel."""
    return view.sensor.detection.kernel()


def reach_of(kind: int, parameters: FloatArray) -> float:
    """Return the horizontal distance beyond which pi is 0, metres; inf if there is none."""
    if kind != BOX:
        return math.inf
    offsets = np.abs(parameters[[1, 2, 4, 5]])
    extra = np.abs(parameters[[3, 6]])
    extra = extra[np.isfinite(extra)]
    reach = math.hypot(float(offsets[[0, 2]].max()), float(offsets[[1, 3]].max()))
    return max([reach, *extra.tolist()]) + 2.0 * float(parameters[7])


def tail_events(view: RobotView, horizon: int, extend: bool) -> Events:
    """Return the predicted measurements of a robot that is not planning."""
    if view.tail is None or len(view.tail) == 0:
        positions = np.array(view.state.pose.position)[None, None, :]
    else:
        positions = np.ascontiguousarray(view.tail, dtype=float)[None, :, :]
    if view.tail is not None and view.tail_yaws is not None and len(view.tail):
        yaws = np.ascontiguousarray(view.tail_yaws, dtype=float)[None, :]
    else:
        yaws = np.full(positions.shape[:2], view.state.pose.yaw)
    lengths = np.array([positions.shape[1] - 1], np.int64)
    # Where the tail ends the robot measures in any case: it plans there.
    return events(
        positions,
        yaws,
        lengths,
        max(0, view.phase),
        view.period_steps,
        horizon,
        view.tail is not None and len(view.tail) > 1,
        extend,
    )


class TeamObjective:
    """Objective of all joint candidates at one step.

    Parameters
    ----------
    team : TeamView
        The team; robots that do not plan count with their tails.
    settings : PlannerSettings
        Weights.
    candidates : mapping of str to (W, 3) array
        Of each planning robot, metres.
    trajectories : mapping of str to Trajectories
        Predictions for them.
    allowed : mapping of str to (W,) array of bool
        Which of them may be chosen.

    Attributes
    ----------
    names : list of str
        Planning robots with candidates, in order.
    joint : Joint
        Tables for the search.
    measurements : (G,) array
        M of each candidate.
    """

    def __init__(
        self,
        team: TeamView,
        settings: PlannerSettings,
        candidates: Mapping[str, FloatArray],
        trajectories: Mapping[str, Trajectories],
        allowed: Mapping[str, BoolArray],
    ) -> None:
        self.team = team
        self.settings = settings
        self.weights = resolve(settings)
        self.names = [name for name in team.planning() if len(candidates[name])]
        counts = np.array([len(candidates[name]) for name in self.names], np.int64)
        self.start = _starts(counts)
        self.robot = np.repeat(np.arange(len(counts)), counts)
        self._alone: FloatArray | None = None
        self._build(candidates, trajectories, allowed)

    def _build(
        self,
        candidates: Mapping[str, FloatArray],
        trajectories: Mapping[str, Trajectories],
        allowed: Mapping[str, BoolArray],
    ) -> None:
        team, weights, names = self.team, self.weights, self.names
        robots = [team.robots[name] for name in names]
        horizon = max((int(trajectories[name].lengths.max(initial=0)) for name in names), default=0)
        kernels = [_required_kernel(name, view) for name, view in zip(names, robots)]
        planned = [
            events(
                trajectories[name].positions,
                trajectories[name].yaws,
                trajectories[name].lengths,
                0,
                view.period_steps,
                horizon,
                weights.arrival,
                weights.extend,
            )
            for name, view in zip(names, robots)
        ]
        self.events = dict(zip(names, planned))
        settled = []
        for name in team.names():
            if name not in names:
                view = team.robots[name]
                kernel = _required_kernel(name, view)
                settled.append((view, kernel, tail_events(view, horizon, weights.extend)))
        first = 0 if weights.present else 1
        lengths = _joined([trajectories[name].lengths for name in names], np.int64)
        if weights.per_distance:
            norm = _joined([trajectories[name].distances() for name in names], float)
        else:
            norm = lengths.astype(float)
        self.lengths = lengths
        self.measurements = _joined([item.own for item in planned], np.int64)
        number = int(self.start[-1])
        clusters = team.clusters
        dimension = team.dimension
        centres = np.zeros((len(clusters), 3))
        for index, cluster in enumerate(clusters):
            centres[index, :dimension] = cluster.position[:dimension]
        refinement = np.zeros(number)
        empty_entries = (
            np.zeros(number + 1, np.int64),
            np.zeros(0),
            np.zeros((0, 3)),
            np.zeros(0, np.int64),
        )
        entries = empty_entries
        rows = (
            np.zeros(number + 1, np.int64),
            np.zeros(0, np.int64),
            np.zeros((0, 3)),
            np.zeros((0, 2)),
        )
        d = dimension
        mass = np.zeros(0)
        covariance = np.zeros((0, d, d))
        base = np.zeros((0, d, d))
        gain = np.zeros((number, 0, d, d))
        unseen = np.zeros(0)
        miss = np.zeros((number, 0))
        if weights.information:
            mass = np.array([min(1.0, max(0.0, cluster.mass)) for cluster in clusters])
            covariance = np.zeros((len(clusters), d, d))
            for index, cluster in enumerate(clusters):
                covariance[index] = cluster.covariance[:d, :d]
            base, gain = self._information(robots, kernels, planned, settled, centres, first)
            if weights.beta > 0.0:
                unseen, miss = self._new_targets(kernels, planned, settled, first)
        else:
            for index, (kernel, item) in enumerate(zip(kernels, planned)):
                _centre_sum(
                    item.places,
                    item.turns,
                    first,
                    item.own,
                    centres,
                    dimension,
                    *kernel,
                    refinement[self.start[index] : self.start[index + 1]],
                )
            if weights.beta > 0.0:
                entries = self._entries(kernels, planned, settled, first)
                if len(names) > 1:
                    rows = _rows(planned)
        pairs = number if len(entries[1]) and len(names) > 1 else 0
        longest = int(np.diff(entries[0]).max(initial=0)) if pairs else 0
        parameters = np.zeros((len(names), PARAMETERS))
        for index, kernel in enumerate(kernels):
            parameters[index] = kernel[1]
        self.joint = Joint(
            start=self.start,
            robot=self.robot,
            allowed=_joined(
                [allowed[name] & (trajectories[name].lengths > 0) for name in names], np.bool_
            ),
            waypoints=_stacked([candidates[name] for name in names], 3),
            radii=np.array([view.radius for view in robots], dtype=float),
            control=_joined([trajectories[name].control_cost for name in names], float),
            norm=np.maximum(norm, 1e-9),
            alpha=float(weights.alpha),
            beta=float(weights.beta),
            control_weight=float(weights.control),
            information=weights.information,
            dimension=dimension,
            refinement=refinement,
            event_start=rows[0],
            event_time=rows[1],
            event_place=rows[2],
            event_turn=rows[3],
            kind=np.array([kernel[0] for kernel in kernels], np.int64),
            parameters=parameters,
            entry_start=entries[0],
            entry_value=entries[1],
            entry_node=entries[2],
            entry_time=entries[3],
            slot=np.full((pairs, pairs), -1, np.int32),
            cache=np.empty((min(CACHE_ROWS, pairs * pairs), longest)),
            used=np.zeros(1, np.int64),
            mass=mass,
            covariance=covariance,
            base=base,
            gain=gain,
            unseen=unseen,
            miss=miss,
        )

    def _entries(
        self,
        kernels: list[tuple[int, FloatArray]],
        planned: list[Events],
        settled: list[tuple[RobotView, tuple[int, FloatArray], Events]],
        first: int,
    ) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
        values, lower, step = self.team.exploration.kernel()
        corners = 4 if self.team.dimension == 2 else 8
        counts, value_parts, node_parts, time_parts = [], [], [], []
        for kernel, item in zip(kernels, planned):
            most = corners * int(item.own.sum())
            count = np.zeros(len(item.own), np.int64)
            entry_value = np.empty(most)
            entry_node = np.empty((most, 3))
            entry_time = np.empty(most, np.int64)
            number = _entries(
                item.times,
                item.places,
                item.turns,
                first,
                item.own,
                self.weights.own,
                self.team.dimension,
                *kernel,
                values,
                lower,
                step,
                count,
                entry_value,
                entry_node,
                entry_time,
            )
            entry_value = entry_value[:number]
            entry_node = entry_node[:number]
            entry_time = entry_time[:number]
            for _, other, tail in settled:
                total = int(tail.total[0])
                _fold(
                    count,
                    entry_value,
                    entry_node,
                    entry_time,
                    tail.times[0, :total],
                    tail.places[0, :total],
                    tail.turns[0, :total],
                    self.team.dimension,
                    *other,
                )
            counts.append(count)
            value_parts.append(entry_value)
            node_parts.append(entry_node)
            time_parts.append(entry_time)
        return (
            _starts(_joined(counts, np.int64)),
            _joined(value_parts, float),
            _stacked(node_parts, 3),
            _joined(time_parts, np.int64),
        )

    def _information(
        self,
        robots: list[RobotView],
        kernels: list[tuple[int, FloatArray]],
        planned: list[Events],
        settled: list[tuple[RobotView, tuple[int, FloatArray], Events]],
        centres: FloatArray,
        first: int,
    ) -> tuple[FloatArray, FloatArray]:
        d = self.team.dimension
        number = len(centres)
        base = np.zeros((number, d, d))
        gain = np.zeros((int(self.start[-1]), number, d, d))
        if number == 0:
            return base, gain
        for view, kernel, tail in settled:
            out = np.zeros((1, number, d, d))
            _add_information(view, kernel, tail, tail.own, 0, centres, d, out)
            base += out[0]
        for index, (view, kernel, item) in enumerate(zip(robots, kernels, planned)):
            rows = slice(int(self.start[index]), int(self.start[index + 1]))
            _add_information(view, kernel, item, item.own, first, centres, d, gain[rows])
            if first:
                # What is measured now is measured whatever is chosen.
                here = _first_row(item)
                out = np.zeros((1, number, d, d))
                _add_information(view, kernel, here, np.minimum(here.own, 1), 0, centres, d, out)
                base += out[0]
        return base, gain

    def _new_targets(
        self,
        kernels: list[tuple[int, FloatArray]],
        planned: list[Events],
        settled: list[tuple[RobotView, tuple[int, FloatArray], Events]],
        first: int,
    ) -> tuple[FloatArray, FloatArray]:
        exploration = self.team.exploration
        values, lower, step = exploration.kernel()
        volumes = exploration.cell_volumes().reshape(values.shape)
        # A view with hard edges needs every node: a place that is left out is never seen.
        hard = any(kernel[0] == BOX for kernel in kernels)
        stride = 1
        if not hard:
            while np.prod([-(-size // stride) for size in values.shape]) > (
                self.settings.exploration_nodes
            ):
                stride += 1
        shape = [-(-size // stride) for size in values.shape]
        left = np.zeros(shape)
        _blocks(values, volumes, stride, left)
        left *= self.settings.expected_targets / float(volumes.sum())
        start = lower + 0.5 * (stride - 1) * step
        if self.team.dimension == 2:
            start[2] = 0.0
        for _, kernel, tail in settled:
            self._see(kernel, tail, 0, tail.own, start, step * stride, left)
        if first:
            for kernel, item in zip(kernels, planned):
                here = _first_row(item)
                self._see(kernel, here, 0, np.minimum(here.own, 1), start, step * stride, left)
        flat = left.ravel()
        columns = np.flatnonzero(flat > 0.0)
        index = np.full(flat.shape, -1, np.int64)
        index[columns] = np.arange(len(columns))
        index = index.reshape(shape)
        miss = np.ones((int(self.start[-1]), len(columns)))
        for i, (kernel, item) in enumerate(zip(kernels, planned)):
            _miss_at_nodes(
                item.places,
                item.turns,
                first,
                item.own,
                start,
                step * stride,
                index,
                self.team.dimension,
                *kernel,
                reach_of(*kernel),
                miss[self.start[i] : self.start[i + 1]],
            )
        return flat[columns], miss

    def _see(
        self,
        kernel: tuple[int, FloatArray],
        item: Events,
        first: int,
        own: IntArray,
        start: FloatArray,
        step: FloatArray,
        left: FloatArray,
    ) -> None:
        index = np.arange(left.size, dtype=np.int64).reshape(left.shape)
        miss = np.ones((1, left.size))
        _miss_at_nodes(
            item.places,
            item.turns,
            first,
            own,
            start,
            step,
            index,
            self.team.dimension,
            *kernel,
            reach_of(*kernel),
            miss,
        )
        left *= miss.reshape(left.shape)

    def alone(self) -> FloatArray:
        """Return T, E and J of each candidate without the other planning robots, (G, 3)."""
        joint = self.joint
        out = np.empty((int(self.start[-1]), 3))
        if joint.information:
            alone_values(joint, out)
        else:
            _alone_on_paper(
                joint.refinement,
                joint.entry_start,
                joint.entry_value,
                joint.control,
                joint.norm,
                joint.allowed,
                joint.alpha,
                joint.beta,
                joint.control_weight,
                out,
            )
        return out

    def given(self, robot: int, chosen: IntArray) -> FloatArray:
        """Return T, E and J of each candidate of one robot, given the others' choices, (W, 3).

        In teams too large for that, all but the chosen one as without the others.
        """
        others = len(self.names) - 1
        if others == 0 or int(self.start[-1]) * others > REPORT_LIMIT:
            if self._alone is None:
                self._alone = self.alone()
            rows = self._alone[self.start[robot] : self.start[robot + 1]].copy()
            g = int(chosen[robot])
            if others and g >= 0:
                rows[g - self.start[robot]] = candidate_value(
                    self.joint, g, chosen, np.zeros((3, 3, 3))
                )
            return rows
        out = np.zeros((int(self.start[robot + 1] - self.start[robot]), 3))
        given_values(self.joint, robot, chosen, out)
        return out

    def value(self, chosen: IntArray) -> float:
        """Return the sum of J of a joint choice (26); indices into all candidates."""
        return float(total_value(self.joint, chosen, np.zeros((3, 3, 3))))

    def search(self) -> tuple[IntArray, float, bool, int]:
        """Return the best joint choice, its value, whether it is exact, and the work done.

        The choice (R,) has indices into all candidates, -1 for a robot with none admissible.
        """
        self._alone = self.alone()
        alone = self._alone[:, 2]
        robots = len(self.names)
        chosen = np.full(robots, -1, np.int64)
        if robots == 0:
            return chosen, 0.0, True, 0
        if robots == 1:
            best_alone = int(alone.argmax())
            if alone[best_alone] > -np.inf:
                chosen[0] = best_alone
            return chosen, float(alone[best_alone]), True, len(alone)
        order = np.zeros(len(alone), np.int64)
        for r in range(robots):
            rows = slice(int(self.start[r]), int(self.start[r + 1]))
            order[rows] = self.start[r] + np.argsort(-alone[rows], kind='stable')
        best = np.full(robots, -1, np.int64)
        rounds = self.settings.improvement_rounds
        alone_best, work = search_in_turn(self.joint, alone, order, rounds, False, best)
        best_value = alone_best
        joint_number = 1.0
        for r in range(robots):
            rows = slice(int(self.start[r]), int(self.start[r + 1]))
            joint_number *= max(1.0, float(np.isfinite(alone[rows]).sum()))
        exact = joint_number <= self.settings.enumeration_limit and bool((best >= 0).all())
        if exact:
            found = best.copy()
            value, count = search_exactly(self.joint, alone, order, found, best_value)
            return found, value, True, work + count
        other = np.full(robots, -1, np.int64)
        value, count = search_in_turn(self.joint, alone, order, rounds, True, other)
        work += count
        tries = [(best, best_value), (other, value)]
        if robots <= PAIRS_LIMIT:
            for index, (trial, value) in enumerate(tries):
                value, count = improve_in_pairs(
                    self.joint, alone, order, value, self.settings.pair_budget, trial
                )
                tries[index] = (trial, value)
                work += count
        # More robots on their way come first, then the larger value.
        best, best_value = max(tries, key=lambda item: (int((item[0] >= 0).sum()), item[1]))
        return best, best_value, False, work


def _required_kernel(name: str, view: RobotView) -> tuple[int, FloatArray]:
    kernel = kernel_of(view)
    if kernel is None:
        raise ValueError(
            f'{name}: got a detection model without a kernel, allowed here are exponential, '
            'gaussian and box'
        )
    return kernel


def _add_information(
    view: RobotView,
    kernel: tuple[int, FloatArray],
    item: Events,
    own: IntArray,
    first: int,
    centres: FloatArray,
    dimension: int,
    out: FloatArray,
) -> None:
    """Add sum pi H' R^-1 H over the measurements to out (W, C, d, d)."""
    most = int(own.max(initial=0))
    if most <= first:
        return
    places = item.places[:, :most]
    offsets = centres[None, None, :, :] - places[:, :, None, :]
    if dimension == 2:
        offsets[..., 2] = 0.0
    sensor = view.sensor
    probabilities = np.zeros(offsets.shape[:3])
    _probabilities(item.turns, offsets, first, own, *kernel, probabilities)
    flat = np.ascontiguousarray(offsets[..., :dimension].reshape(-1, dimension))
    # Nearer than the noise of the range the linear model would promise too much.
    least = math.sqrt(float(sensor.covariance[0, 0]))
    distance = np.sqrt((flat * flat).sum(axis=1))
    flat = flat * np.maximum(1.0, least / np.maximum(distance, 1e-12))[:, None]
    needed = np.flatnonzero(probabilities.ravel() > 0.0)
    matrices = np.zeros((len(flat), dimension, dimension))
    if len(needed):
        jacobian = sensor.measurement.jacobian(flat[needed], Pose(np.zeros(3)))
        whitened = _whitened(jacobian, sensor.covariance)
        matrices[needed] = whitened
    _information(
        matrices.reshape(*probabilities.shape, dimension, dimension),
        probabilities,
        first,
        np.asarray(own),
        out,
    )


def _whitened(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return H' R^-1 H for each H (n, d, d), by Cholesky's factors in plain sums."""
    d = covariance.shape[0]
    lower = np.zeros((d, d))
    for i in range(d):
        for j in range(i + 1):
            rest = float(covariance[i, j]) - sum(float(lower[i, k] * lower[j, k]) for k in range(j))
            lower[i, j] = math.sqrt(rest) if i == j else rest / lower[j, j]
    rows: list[FloatArray] = []
    for i in range(d):
        row = jacobian[:, i, :].copy()
        for k in range(i):
            row -= lower[i, k] * rows[k]
        rows.append(row / lower[i, i])
    out = np.zeros((len(jacobian), d, d))
    for row in rows:
        out += row[:, :, None] * row[:, None, :]
    return out


@njit(cache=True)
def _probabilities(
    turns: FloatArray,
    offsets: FloatArray,
    first: int,
    own: IntArray,
    kind: int,
    parameters: FloatArray,
    out: FloatArray,
) -> None:  # pragma: no cover - compiled
    for w in range(offsets.shape[0]):
        for i in range(first, own[w]):
            for c in range(offsets.shape[2]):
                out[w, i, c] = detection_probability_at(
                    kind,
                    parameters,
                    offsets[w, i, c, 0],
                    offsets[w, i, c, 1],
                    offsets[w, i, c, 2],
                    turns[w, i, 0],
                    turns[w, i, 1],
                )


def _rows(planned: list[Events]) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return the events of all candidates one after the other."""
    totals = _joined([item.total for item in planned], np.int64)
    start = _starts(totals)
    keep = [np.arange(item.times.shape[1])[None, :] < item.total[:, None] for item in planned]
    return (
        start,
        _joined([item.times[mask] for item, mask in zip(planned, keep)], np.int64),
        _stacked([item.places[mask] for item, mask in zip(planned, keep)], 3),
        _stacked([item.turns[mask] for item, mask in zip(planned, keep)], 2),
    )


def _starts(counts: IntArray) -> IntArray:
    """Return where each of several parts begins, one after the other, and where the last ends."""
    # For the few that there are quicker than NumPy's sums.
    return np.array([0, *accumulate(counts.tolist())], np.int64)


def _joined(parts: list, dtype: type) -> NDArray:
    if len(parts) == 1:
        return np.ascontiguousarray(parts[0], dtype)
    return np.concatenate(parts).astype(dtype, copy=False) if parts else np.zeros(0, dtype)


def _stacked(parts: list, width: int) -> FloatArray:
    if len(parts) == 1:
        return np.ascontiguousarray(parts[0])
    return np.concatenate(parts) if parts else np.zeros((0, width))
