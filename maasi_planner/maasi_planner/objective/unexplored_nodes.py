"""What predicted measurements leave unseen at the nodes of the exploration grid."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.models.detection import (
    BOX,
    detection_probability_at,
    fill_probabilities,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


# Room for so many offsets at a time: x, y, z and pi.
ROOM = 1024

ROOM_ROWS = 4


@njit(cache=True)
def is_vectorised(kind: int) -> bool:
    """Return whether many pi at a time are quicker than one by one with an early end.

    That is where pi does not depend on the heading and is nowhere 0.
    """
    return kind < BOX


@njit(cache=True)
def fill_detection(kind: int, parameters: FloatArray, number: int, room: FloatArray) -> FloatArray:
    """Return pi at the first `number` offsets in room (rows x, y, z and one more)."""
    fill_probabilities(kind, parameters, room[0], room[1], room[2], number, 1.0, 0.0, room[3])
    return room[3]


@njit(cache=True)
def apply_misses(
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
) -> None:
    """Multiply values at nodes (n, 3) by what a row of measurements leaves there.

    Of the measurements those count that are at least `margin` steps before `until` (n,); neither
    these times nor those of the measurements decrease.
    """
    number = nodes.shape[0]
    if not is_vectorised(kind):
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
            chances = fill_detection(kind, parameters, filled, room)
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
def own_products(
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
) -> None:
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
            chances = fill_detection(kind, parameters, filled, room)
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
) -> int:
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
def entries_of(
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
) -> int:
    """Fill the nodes of (22): weight times e times the robot's own product (21), if above 0."""
    most = 0
    for w in range(places.shape[0]):
        most = max(most, own[w])
    size = (4 if dimension == 2 else 8) * most
    shared = np.empty(size, np.int64)
    measurement = np.empty(size, np.int64)
    before = np.empty((2, 8), np.int64)
    together = is_vectorised(kind)
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
                own_products(
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
def miss_at_nodes(
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
) -> None:
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
def block_sums(values: FloatArray, volumes: FloatArray, stride: int, out: FloatArray) -> None:
    """Add values times volumes, summed over blocks of `stride` nodes on each axis, to `out`."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            for k in range(values.shape[2]):
                out[i // stride, j // stride, k // stride] += values[i, j, k] * volumes[i, j, k]
