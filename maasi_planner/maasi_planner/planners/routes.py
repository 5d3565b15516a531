"""Routes of a team over nodes with prizes, and a local search that makes them cheaper.

Each route begins at a start and ends at an end; nodes may be on none. Moves connect near nodes: by
reversing a part of a route, by moving up to three nodes, or by exchanging parts of two routes. Sums
along the routes give the cost of a move in constant time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.arrays import BoolArray, FloatArray, IntArray

# Most nodes that move together.
LONGEST = 3
_NONE = (0, 1, 0, 0)


class Places(NamedTuple):
    """Nodes, starts and ends (m, 3), those that are free, prizes (m,), nearest nodes of each."""

    points: FloatArray
    free: BoolArray
    prizes: FloatArray
    near: IntArray


class Routes(NamedTuple):
    """Nodes of each route in order (r, n + 2), with start and end, and their numbers (r,).

    where (m, 2): route and index of each node; -1: on none. ways, sums, moments (r, n + 2):
    distance along the route to each node, and sums before it, of prizes and of prizes times
    distance. kept, numbers, touched: the routes before they were changed. queue (m + 1,), active
    (m,): nodes whose moves are to be tried; the queue's last entry is their number. loose (n + 2,):
    nodes that were removed, and their number. state: of the random numbers.
    """

    order: IntArray
    counts: IntArray
    where: IntArray
    ways: FloatArray
    sums: FloatArray
    moments: FloatArray
    kept: IntArray
    numbers: IntArray
    touched: BoolArray
    queue: IntArray
    active: BoolArray
    loose: IntArray
    state: NDArray[np.uint64]

    def lengths(self) -> FloatArray:
        """Return the length of each route, (r,) [m]."""
        return self.ways[np.arange(len(self.counts)), self.counts + 1]

    def visited(self) -> list[IntArray]:
        """Return the nodes of each robot."""
        return [row[1 : count + 1] for row, count in zip(self.order, self.counts)]


def make_routes(places: Places, rows: list[IntArray]) -> Routes:
    """Return routes with the nodes of each robot."""
    robots, m = len(rows), len(places.points)
    n = m - 2 * robots
    order, counts = np.zeros((robots, n + 2), np.int64), np.zeros(robots, np.int64)
    where, active = np.full((m, 2), -1), np.zeros(m, np.bool_)
    sums, loose, queue = np.zeros((3, robots, n + 2)), order[0].copy(), np.zeros(m + 1, np.int64)
    changes = order.copy(), counts.copy(), np.zeros(robots, np.bool_)
    state = np.array([88172645463325252], np.uint64)
    routes = Routes(
        order, counts, where, sums[0], sums[1], sums[2], *changes, queue, active, loose, state
    )
    for k, row in enumerate(rows):
        order[k, : len(row) + 2] = [n + k, *row, n + robots + k]
        counts[k] = len(row)
        _take(places, routes, k, 0)
    return routes


@njit(cache=True)
def gap_between(points, free, a, b):  # type: ignore[no-untyped-def]
    """Return the distance of two nodes [m]; 0 to one that may be anywhere."""
    if free[a] or free[b]:
        return 0.0
    x, y, z = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True)
def draw(routes):  # type: ignore[no-untyped-def]
    """Return a random number from 0 to 1, by xorshift."""
    x = routes.state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    routes.state[0] = x
    return (x >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True)
def _take(places, routes, k, i):  # type: ignore[no-untyped-def]
    """Add up along a route from place i on."""
    way = total = late = 0.0
    if i > 0:
        way, total, late = routes.ways[k, i - 1], routes.sums[k, i - 1], routes.moments[k, i - 1]
    for j in range(i, routes.counts[k] + 2):
        b = routes.order[k, j]
        if j > 0:
            a = routes.order[k, j - 1]
            total += places.prizes[a]
            late += places.prizes[a] * way
            way += gap_between(places.points, places.free, a, b)
        routes.where[b, 0], routes.where[b, 1] = k, j
        routes.ways[k, j], routes.sums[k, j], routes.moments[k, j] = way, total, late


@njit(cache=True)
def _set(places, routes, k, row, number):  # type: ignore[no-untyped-def]
    """Replace a route by the first places of a row."""
    i = 0
    while i < min(number, routes.counts[k] + 2) and routes.order[k, i] == row[i]:
        i += 1
    routes.order[k, i:number] = row[i:number]
    routes.counts[k] = number - 2
    _take(places, routes, k, i)


@njit(cache=True)
def _save(routes, k):  # type: ignore[no-untyped-def]
    """Keep a route before it is changed."""
    if not routes.touched[k]:
        routes.touched[k], routes.numbers[k] = True, routes.counts[k]
        routes.kept[k, : routes.counts[k] + 2] = routes.order[k, : routes.counts[k] + 2]


@njit(cache=True)
def restore(places, routes, order, counts):  # type: ignore[no-untyped-def]
    """Change routes back to what they were."""
    for k in np.flatnonzero(routes.touched):
        for v in routes.order[k, 1 : routes.counts[k] + 1]:
            routes.where[v, 0] = -1
    for k in np.flatnonzero(routes.touched):
        routes.order[k], routes.counts[k] = order[k], counts[k]
        _take(places, routes, k, 0)


@njit(cache=True)
def _weighed(term, length, late, prize):  # type: ignore[no-untyped-def]
    over = length - term[3]
    # A route that is too long costs more than any that fits.
    late_cost = term[4] * (over + 1e-3 * term[3]) if over > 0.0 else 0.0
    return term[0] * length + term[1] * late - term[2] * prize + late_cost


@njit(cache=True)
def cost_now(routes, terms, k):  # type: ignore[no-untyped-def]
    """Return the cost of a route."""
    end = routes.counts[k] + 1
    return _weighed(terms[k], routes.ways[k, end], routes.moments[k, end], routes.sums[k, end])


@njit(cache=True)
def _cost(places, routes, parts, term):  # type: ignore[no-untyped-def]
    """Return the cost of a route of parts (route, first, last, backwards) of the present ones."""
    order, counts, ways = routes.order, routes.counts, routes.ways
    length = late = prize = 0.0
    end = -1
    for k, i, j, back in parts:
        if i > j:
            continue
        # Ends have no prize.
        after = min(j + 1, counts[k] + 1)
        weight = routes.sums[k, after] - routes.sums[k, i]
        moment = routes.moments[k, after] - routes.moments[k, i]
        first, last = (order[k, j], order[k, i]) if back else (order[k, i], order[k, j])
        if end >= 0:
            length += gap_between(places.points, places.free, end, first)
        late += weight * length
        late += ways[k, j] * weight - moment if back else moment - ways[k, i] * weight
        length += ways[k, j] - ways[k, i]
        prize += weight
        end = last
    return _weighed(term, length, late, prize)


@njit(cache=True)
def _move(number, counts, k, i, h, j):  # type: ignore[no-untyped-def]
    """Return the parts of routes k and h after a move that connects place i of k with j of h.

    Without a part where it cannot be made.
    """
    nothing = (_NONE, _NONE, _NONE, _NONE)
    m, o = counts[k] + 1, counts[h] + 1
    if number < 4 * LONGEST:
        # Nodes x to y move behind place q: j next to i, before or behind it, forwards or backwards.
        size, kind = number // 4, number % 4
        x, y = (j - size, j) if kind in (1, 2) else (j, j + size)
        q, back = i - kind // 2, kind % 2
        if x < 1 or y >= o or q < 0 or q >= m or (k == h and x - 1 <= q <= y):
            return nothing, nothing
        if k != h:
            longer = ((k, 0, q, 0), (h, x, y, back), (k, q + 1, m, 0), _NONE)
            return longer, ((h, 0, x - 1, 0), (h, y + 1, o, 0), _NONE, _NONE)
        if q < x:
            here = ((k, 0, q, 0), (k, x, y, back), (k, q + 1, x - 1, 0), (k, y + 1, m, 0))
        else:
            here = ((k, 0, x - 1, 0), (k, y + 1, q, 0), (k, x, y, back), (k, q + 1, m, 0))
        return here, nothing
    back = number - 4 * LONGEST
    if k == h:
        # The part between them is turned round.
        x, y = min(i, j) + 1 - back, max(i, j) - back
        if x < 1 or y >= m:
            return nothing, nothing
        return ((k, 0, x - 1, 0), (k, x, y, 1), (k, y + 1, m, 0), _NONE), nothing
    # Parts of both routes are exchanged: up to the ends, or against the beginning.
    if j < 1 or j >= o or i >= m:
        return nothing, nothing
    if back:
        mine = ((k, 0, i, 0), (h, 1, j, 1), (k, m, m, 0), _NONE)
        return mine, ((h, 0, 0, 0), (k, i + 1, m - 1, 1), (h, j + 1, o, 0), _NONE)
    mine = ((k, 0, i, 0), (h, j, o - 1, 0), (k, m, m, 0), _NONE)
    return mine, ((h, 0, j - 1, 0), (k, i + 1, m - 1, 0), (h, o, o, 0), _NONE)


@njit(cache=True)
def _wake(routes, place):  # type: ignore[no-untyped-def]
    if not routes.active[place]:
        routes.active[place] = True
        routes.queue[-1] += 1
        routes.queue[routes.queue[-1] - 1] = place


@njit(cache=True)
def _joined(routes, parts, row):  # type: ignore[no-untyped-def]
    """Put the places of parts into a row, wake where they begin and end; return their number."""
    length = 0
    for k, i, j, back in parts:
        for step in range(j - i + 1):
            row[length] = routes.order[k, j - step if back else i + step]
            if step == 0 or step == j - i:
                _wake(routes, row[length])
            length += 1
    return length


@njit(cache=True)
def improve(places, routes, terms, everywhere):  # type: ignore[no-untyped-def]
    """Make the best move at each active place until none makes the routes cheaper."""
    # Less is the rounding of sums that cancel.
    least = 1e-9 * np.abs(terms[:, 2]).max() * places.prizes.sum()
    for k in range(len(terms)):
        end = routes.counts[k] + 1
        least += 1e-9 * terms[k, 0] * routes.ways[k, end]
        least += 1e-9 * terms[k, 1] * routes.moments[k, end]
    rows = np.empty((2, routes.order.shape[1]), np.int64)
    if everywhere:
        for a in range(len(places.near) - 1, -1, -1):
            _wake(routes, a)
    while routes.queue[-1]:
        routes.queue[-1] -= 1
        a = routes.queue[routes.queue[-1]]
        routes.active[a] = False
        kind, k, i, h, j = _best_move(places, routes, terms, least, a)
        if kind >= 0:
            first, second = _move(kind, routes.counts, k, i, h, j)
            _save(routes, k)
            _save(routes, h)
            one, other = _joined(routes, first, rows[0]), _joined(routes, second, rows[1])
            _wake(routes, a)
            _set(places, routes, k, rows[0], one)
            if k != h:
                _set(places, routes, h, rows[1], other)


@njit(cache=True)
def _best_move(places, routes, terms, least, a):  # type: ignore[no-untyped-def]
    """Return the best move that connects a place with a near node; -1: none."""
    best, chosen = least, (-1, 0, 0, 0, 0)
    k, i = routes.where[a]
    if k < 0 or a >= len(places.near):
        return chosen
    ahead = behind = math.inf
    if terms[k, 1] == 0.0:
        # A new leg has to be shorter than the one that it replaces.
        ahead = routes.ways[k, i + 1] - routes.ways[k, i]
        behind = routes.ways[k, i] - routes.ways[k, i - 1] if i else 0.0
    for b in places.near[a]:
        gap = gap_between(places.points, places.free, a, b)
        if b < 0 or gap >= max(ahead, behind):
            break
        h, j = routes.where[b]
        if h < 0:
            continue
        before = cost_now(routes, terms, k)
        if k != h:
            before += cost_now(routes, terms, h)
        for kind in range(4 * LONGEST + 2):
            back = kind // 2 % 2 if kind < 4 * LONGEST else kind % 2 and k == h
            if gap >= (behind if back else ahead):
                continue
            first, second = _move(kind, routes.counts, k, i, h, j)
            if first[0][1] > first[0][2]:
                continue
            after = _cost(places, routes, first, terms[k])
            if k != h:
                after += _cost(places, routes, second, terms[h])
            if before - after > best:
                best, chosen = before - after, (kind, k, i, h, j)
    return chosen


@njit(cache=True)
def entry_cost(places, routes, term, k, i, v, hard):  # type: ignore[no-untyped-def]
    """Return what it costs to put a node behind place i of a route; inf: too long."""
    end = routes.counts[k] + 1
    there = gap_between(places.points, places.free, routes.order[k, i], v)
    detour = there + gap_between(places.points, places.free, v, routes.order[k, i + 1])
    detour -= routes.ways[k, i + 1] - routes.ways[k, i]
    if hard and routes.ways[k, end] + detour > term[3]:
        return math.inf
    late = places.prizes[v] * (routes.ways[k, i] + there)
    late += detour * (routes.sums[k, end] - routes.sums[k, i + 1])
    return max(term[0] * detour + term[1] * late, 1e-9 * term[0])


@njit(cache=True)
def best_entry(places, routes, terms, v, hard):  # type: ignore[no-untyped-def]
    """Return the least cost of a node, and behind which place of which route that is."""
    best, route, place = math.inf, -1, -1
    robots = len(terms)
    for rank in range(places.near.shape[1] + robots):
        # At near nodes, and at both ends of each route.
        k, i, step = rank - places.near.shape[1], 0, 0
        if k >= 0:
            step = max(routes.counts[k], 1)
        elif places.near[v, rank] >= 0:
            k, i = routes.where[places.near[v, rank]]
            i, step = i - 1, 1
        if k >= 0:
            for j in (i, i + step):
                if j <= routes.counts[k]:
                    cost = entry_cost(places, routes, terms[k], k, j, v, hard)
                    if cost < best:
                        best, route, place = cost, k, j
    return best, route, place


@njit(cache=True)
def insert(places, routes, k, i, v):  # type: ignore[no-untyped-def]
    """Put a node behind place i of a route."""
    _save(routes, k)
    order, ways, sums, moments = routes.order, routes.ways, routes.sums, routes.moments
    for j in range(routes.counts[k] + 1, i, -1):
        order[k, j + 1] = order[k, j]
    order[k, i + 1] = v
    routes.counts[k] += 1
    there = ways[k, i] + gap_between(places.points, places.free, order[k, i], v)
    detour = there + gap_between(places.points, places.free, v, order[k, i + 2]) - ways[k, i + 1]
    prize, before = places.prizes[v], sums[k, i + 1]
    for j in range(routes.counts[k] + 1, i + 1, -1):
        routes.where[order[k, j], 1] = j
        moments[k, j] = moments[k, j - 1] + prize * there + detour * (sums[k, j - 1] - before)
        ways[k, j] = ways[k, j - 1] + detour
        sums[k, j] = sums[k, j - 1] + prize
    ways[k, i + 1] = there
    routes.where[v, 0], routes.where[v, 1] = k, i + 1
    for j in range(i, i + 3):
        _wake(routes, order[k, j])


@njit(cache=True)
def remove(places, routes, k, i, number):  # type: ignore[no-untyped-def]
    """Remove nodes from place i of a route on."""
    _save(routes, k)
    order, loose = routes.order[k], routes.loose
    for v in order[i : i + number]:
        routes.where[v, 0] = -1
        loose[-1] += 1
        loose[loose[-1] - 1] = v
    for j in range(i, routes.counts[k] + 2 - number):
        order[j] = order[j + number]
    routes.counts[k] -= number
    _take(places, routes, k, i)
    _wake(routes, order[i - 1])
    _wake(routes, order[i])
