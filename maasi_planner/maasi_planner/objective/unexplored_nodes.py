"""What predicted measurements leave unseen at the nodes of the exploration grid."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.models.detection import BOX, detection_probability_at, fill_probabilities
from maasi_planner.objective.predicted_measurements import Events, Kernel, Measurements

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Offsets that are processed at a time, and rows for them: x, y, z and pi.
ROOM = 1024
ROOM_ROWS = 4


class Entries(NamedTuple):
    """Nodes of (22), the candidates one after the other.

    counts (W,) nodes of each candidate; of each node value (n,): its weight times what is unseen,
    node (n, 3) [m], and time (n,): that of the measurement [steps from now].
    """

    counts: IntArray
    value: FloatArray
    node: FloatArray
    time: IntArray


class _Corners(NamedTuple):
    """Scratch of `_nodes_around`.

    shared (n,): entries of the same node in a row have the same number; measurement (n,): the
    index of that of the entry; before (2, 8): nodes of the last two measurements.
    """

    shared: IntArray
    measurement: IntArray
    before: IntArray


class _Products(NamedTuple):
    """Scratch of `_apply_own_misses`: counts, begin (n + 2,), rank (8 n,), work (4, 8 n), room."""

    counts: IntArray
    begin: IntArray
    rank: IntArray
    work: FloatArray
    room: FloatArray


class NodeGrid(NamedTuple):
    """Nodes of a grid: the first and the distances [m], and column (nx, ny, nz), -1: left out."""

    start: FloatArray
    step: FloatArray
    column: IntArray


@njit(cache=True)
def is_vectorised(kind: int) -> bool:
    """Return whether many pi at a time are quicker than one by one with an early end.

    That is where pi does not depend on the heading and is nowhere 0.
    """
    return kind < BOX


@njit(cache=True)
def fill_detection(kernel: Kernel, number: int, room: FloatArray) -> FloatArray:
    """Return pi at the first `number` offsets in room (rows x, y, z and one more)."""
    kind, parameters = kernel
    fill_probabilities(kind, parameters, room[0], room[1], room[2], number, 1.0, 0.0, room[3])
    return room[3]


@njit(cache=True)
def apply_misses(
    nodes: FloatArray,
    until: IntArray,
    measured: Measurements,
    dimension: int,
    kernel: Kernel,
    values: FloatArray,
) -> None:
    """Multiply values at nodes (n, 3) by 1 - pi of the measurements up to the times `until` (n,).

    Neither these times nor those of the measurements decrease.
    """
    kind, parameters = kernel
    times, places, turns = measured
    number = nodes.shape[0]
    if not is_vectorised(kind):
        for i in range(number):
            left = values[i]
            for e in range(times.shape[0]):
                if times[e] > until[i] or left <= 0.0:
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
    # In blocks as large as the scratch array.
    room = np.empty((ROOM_ROWS, max(ROOM, number)))
    first = np.empty(times.shape[0], np.int64)
    begin = 0
    filled = 0
    done = 0
    for e in range(times.shape[0] + 1):
        width = 0
        if e < times.shape[0]:
            while begin < number and until[begin] < times[e]:
                begin += 1
            width = number - begin
        if width == 0 or filled + width > room.shape[1]:
            chances = fill_detection(kernel, filled, room)
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
def _apply_own_misses(
    corners: _Corners,
    entries: Entries,
    number: int,
    places: FloatArray,
    margin: int,
    dimension: int,
    kernel: Kernel,
    scratch: _Products,
) -> None:
    """Multiply the first `number` entries by what a row of measurements leaves at them (21).

    Of the measurements at `places` (n, 3) those count that are at least `margin` before that of an
    entry, which does not decrease. What is left at a node that several entries in a row share is
    multiplied on.
    """
    shared, time = corners.shared[:number], corners.measurement[:number]
    nodes, values = entries.node[:number], entries.value[:number]
    counts, begin, rank, work, room = scratch
    measurements = places.shape[0]
    unique = 0
    for q in range(number):
        # The last entry of a node stays.
        rank[shared[q]] = time[q]
        unique = max(unique, shared[q] + 1)
    # Sorted by their last measurement, the nodes that a measurement concerns are one slice.
    counts[: measurements + 2] = 0
    for u in range(unique):
        counts[rank[u] + 1] += 1
    for m in range(measurements):
        counts[m + 1] += counts[m]
        begin[m] = counts[m]
    for u in range(unique):
        last = rank[u]
        rank[u] = counts[last]
        counts[last] += 1
    x, y, z = work[0, :unique], work[1, :unique], work[2, :unique]
    left = work[3, :unique]
    left[:] = 1.0
    for q in range(number):
        u = rank[shared[q]]
        x[u] = nodes[q, 0]
        y[u] = nodes[q, 1]
        z[u] = nodes[q, 2]
    done = 0
    filled = 0
    entry = 0
    for e in range(measurements + 1):
        width = 0
        if e + margin < measurements:
            width = unique - begin[e + margin]
        if width == 0 or filled + width > room.shape[1]:
            chances = fill_detection(kernel, filled, room)
            for m in range(done, e):
                later = left[begin[m + margin] :]
                for i in range(later.shape[0]):
                    later[i] *= 1.0 - chances[i]
                chances = chances[later.shape[0] :]
                while entry < number and time[entry] < m + margin:
                    entry += 1
                while entry < number and time[entry] == m + margin:
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
    item: Events,
    w: int,
    first: int,
    dimension: int,
    grid: tuple[FloatArray, FloatArray, FloatArray],
    corners: _Corners,
    out: Entries,
) -> int:
    """Fill the nodes around the measurements of trajectory w: weight times e, if above 0.

    Return how many there are.
    """
    values, lower, step = grid
    shared, measurement, before = corners
    number = 0
    unique = 0
    depth = 2 if dimension == 3 else 1
    before[:] = -1
    ci, cj, ck = np.int64(-9), np.int64(-9), np.int64(0)
    for m in range(first, item.own[w]):
        pi, pj, pk = ci, cj, ck
        fz = 0.0
        ci, fx = _cell(item.places[w, m, 0], lower[0], step[0], values.shape[0])
        cj, fy = _cell(item.places[w, m, 1], lower[1], step[1], values.shape[1])
        if depth == 2:
            ck, fz = _cell(item.places[w, m, 2], lower[2], step[2], values.shape[2])
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
                    # Corner of the previous place at the same node, if any; branch-free, as the
                    # branches would be mispredicted.
                    a, b, c = i + ci - pi, j + cj - pj, k + ck - pk
                    known = before[1 - now, (4 * a + 2 * b + c) & 7]
                    new = (((a | b | c) & ~1) != 0) | (known < 0)
                    same = unique if new else known
                    unique += 1 if new else 0
                    before[now, corner] = same
                    shared[number] = same
                    measurement[number] = m
                    out.value[number] = weight
                    out.node[number, 0] = x
                    out.node[number, 1] = y
                    out.node[number, 2] = lower[2] + (ck + k) * step[2]
                    out.time[number] = item.times[w, m]
                    number += 1
    return number


@njit(cache=True)
def _keep_unseen(
    item: Events,
    w: int,
    measurement: IntArray,
    margin: int,
    dimension: int,
    kernel: Kernel,
    entries: Entries,
) -> int:
    """Do what `_apply_own_misses` does, one by one, and drop the entries where nothing is left.

    Return how many are kept.
    """
    kind, parameters = kernel
    places, turns = item.places[w], item.turns[w]
    kept = 0
    for q in range(measurement.shape[0]):
        left = entries.value[q]
        e = measurement[q] - margin
        # Latest first: with a hard-edged field of view the product ends early.
        while e >= 0 and left > 0.0:
            left *= 1.0 - detection_probability_at(
                kind,
                parameters,
                entries.node[q, 0] - places[e, 0],
                entries.node[q, 1] - places[e, 1],
                (entries.node[q, 2] - places[e, 2]) if dimension == 3 else 0.0,
                turns[e, 0],
                turns[e, 1],
            )
            e -= 1
        if left > 0.0:
            entries.value[kept] = left
            entries.node[kept] = entries.node[q]
            entries.time[kept] = entries.time[q]
            kept += 1
    return kept


@njit(cache=True)
def entries_of(
    item: Events,
    first: int,
    own_counts: bool,
    dimension: int,
    kernel: Kernel,
    grid: tuple[FloatArray, FloatArray, FloatArray],
    out: Entries,
) -> int:
    """Fill the nodes of (22): weight times e times the robot's own product (21), if above 0.

    `first` is the first measurement that counts, `own_counts` whether a measurement itself is in
    its product, `grid` the values, first node and distances of e. Return the number of nodes.
    """
    most = 0
    for w in range(item.own.shape[0]):
        most = max(most, item.own[w])
    size = (4 if dimension == 2 else 8) * most
    corners = _Corners(
        np.empty(size, np.int64), np.empty(size, np.int64), np.empty((2, 8), np.int64)
    )
    together = is_vectorised(kernel[0])
    rows = size if together else 0
    scratch = _Products(
        np.empty(most + 2, np.int64),
        np.empty(most + 2, np.int64),
        np.empty(rows, np.int64),
        np.empty((4, rows)),
        np.empty((ROOM_ROWS, max(ROOM, rows))),
    )
    margin = 0 if own_counts else 1
    number = 0
    for w in range(item.own.shape[0]):
        rest = Entries(out.counts, out.value[number:], out.node[number:], out.time[number:])
        found = _nodes_around(item, w, first, dimension, grid, corners, rest)
        if not together:
            measurement = corners.measurement[:found]
            found = _keep_unseen(item, w, measurement, margin, dimension, kernel, rest)
        elif found:
            places = item.places[w, : item.own[w]]
            _apply_own_misses(corners, rest, found, places, margin, dimension, kernel, scratch)
        out.counts[w] = found
        number += found
    return number


@njit(cache=True)
def box_within(
    place: FloatArray,
    reach: float,
    start: FloatArray,
    step: FloatArray,
    shape: tuple[int, int, int],
    box: IntArray,
) -> None:
    """Write the first and one past the last node within `reach` of a place, into box (2, 3).

    Axes without a distance between their nodes are in the box as a whole.
    """
    for axis in range(3):
        box[0, axis] = 0
        box[1, axis] = shape[axis]
        if reach < np.inf and step[axis] > 0.0:
            centre = (place[axis] - start[axis]) / step[axis]
            width = reach / step[axis]
            box[0, axis] = min(max(math.floor(centre - width), 0), shape[axis])
            box[1, axis] = max(min(math.ceil(centre + width) + 1, shape[axis]), 0)


@njit(cache=True)
def _miss_at_all_nodes(
    item: Events, first: int, grid: NodeGrid, dimension: int, kernel: Kernel, miss: FloatArray
) -> None:
    """Do what `miss_at_nodes` does, all nodes of a measurement at a time."""
    start, step, columns = grid
    number = miss.shape[1]
    x, y, z = np.empty(number), np.empty(number), np.zeros(number)
    for i in range(columns.shape[0]):
        for j in range(columns.shape[1]):
            for k in range(columns.shape[2]):
                column = columns[i, j, k]
                if column >= 0:
                    x[column] = start[0] + i * step[0]
                    y[column] = start[1] + j * step[1]
                    if dimension == 3:
                        z[column] = start[2] + k * step[2]
    room = np.empty((ROOM_ROWS, number))
    dx, dy, dz = room[0], room[1], room[2]
    dz[:] = 0.0
    for w in range(item.own.shape[0]):
        left = miss[w]
        for m in range(first, item.own[w]):
            x0, y0, z0 = item.places[w, m]
            for i in range(number):
                dx[i] = x[i] - x0
                dy[i] = y[i] - y0
            if dimension == 3:
                for i in range(number):
                    dz[i] = z[i] - z0
            chances = fill_detection(kernel, number, room)
            for i in range(number):
                left[i] *= 1.0 - chances[i]


@njit(cache=True)
def miss_at_nodes(
    item: Events,
    first: int,
    grid: NodeGrid,
    dimension: int,
    kernel: Kernel,
    reach: float,
    miss: FloatArray,
) -> None:
    """Multiply `miss` (W, L) by 1 - pi of each measurement from `first` on at the nodes.

    Only nodes within `reach` of a measurement are visited.
    """
    kind, parameters = kernel
    start, step, columns = grid
    if is_vectorised(kind):
        _miss_at_all_nodes(item, first, grid, dimension, kernel, miss)
        return
    box = np.zeros((2, 3), np.int64)
    for w in range(item.own.shape[0]):
        for m in range(first, item.own[w]):
            place = item.places[w, m]
            box_within(place, reach, start, step, columns.shape, box)
            for i in range(box[0, 0], box[1, 0]):
                dx = start[0] + i * step[0] - place[0]
                for j in range(box[0, 1], box[1, 1]):
                    dy = start[1] + j * step[1] - place[1]
                    for k in range(box[0, 2], box[1, 2]):
                        column = columns[i, j, k]
                        if column < 0:
                            continue
                        dz = 0.0
                        if dimension == 3:
                            dz = start[2] + k * step[2] - place[2]
                        miss[w, column] *= 1.0 - detection_probability_at(
                            kind, parameters, dx, dy, dz, item.turns[w, m, 0], item.turns[w, m, 1]
                        )


@njit(cache=True)
def block_sums(values: FloatArray, volumes: FloatArray, stride: int, out: FloatArray) -> None:
    """Add values times volumes, summed over blocks of `stride` nodes on each axis, to `out`."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            for k in range(values.shape[2]):
                out[i // stride, j // stride, k // stride] += values[i, j, k] * volumes[i, j, k]
