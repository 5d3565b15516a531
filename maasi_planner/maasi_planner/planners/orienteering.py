"""Ways of a team that collect prizes within budgets, or all of them early, by local search.

Each route begins at a start and ends at an end; the last route holds the nodes that nobody visits.
Moves connect near nodes: by turning a part of a route round, by moving up to three nodes, or by
exchanging parts of two routes. Sums along the routes give the cost of a move in constant time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from maasi_filter.arrays import BoolArray, FloatArray, IntArray

# Nearest nodes that moves connect, most nodes that move together, and rounds of prices.
NEIGHBOURS = 8
LONGEST = 3
ROUNDS = 6
# Within budgets the best nodes are looked at, so many times those that can be visited; and never
# more than so many: for 2,000 nodes ways take 0.2 s.
CHOICE, MOST = 1.2, 2000
_NONE = (0, 1, 0, 0)


class _Places(NamedTuple):
    """Nodes, starts and ends (m, d), those that are free, prizes (m,), nearest nodes of each."""

    points: FloatArray
    free: BoolArray
    prizes: FloatArray
    near: IntArray


class _Routes(NamedTuple):
    """Places in order (r + 1, n + 3), numbers of nodes (r + 1,), and where each place is (m, 2).

    ways, sums, moments (r + 1, n + 3): way to each place, and sums of prizes, and of prizes times
    way, before it.
    """

    order: IntArray
    counts: IntArray
    where: IntArray
    ways: FloatArray
    sums: FloatArray
    moments: FloatArray

    def lengths(self) -> FloatArray:
        """Return the way of each robot, (r,) [m]."""
        return self.ways[np.arange(len(self.counts)), self.counts + 1][:-1]

    def visited(self) -> list[IntArray]:
        """Return the nodes of each robot."""
        return [row[1 : count + 1] for row, count in zip(self.order, self.counts)][:-1]


def plan_ways(
    nodes: FloatArray,
    prizes: FloatArray,
    starts: FloatArray | None,
    budgets: FloatArray,
    ends: FloatArray | None = None,
    speeds: FloatArray | None = None,
    known: list[IntArray] | None = None,
) -> list[IntArray]:
    """Return the nodes that each robot visits, in order.

    Within the budgets as much prize as possible is collected. Where they suffice for all nodes
    with a prize, those are visited so that the sum of prize times arrival is small.

    Parameters
    ----------
    nodes : (n, d) array
        Places to visit, metres.
    prizes : (n,) array
        What a visit is worth, from 0.
    starts : (r, d) array or None
        Where robots are, metres; None: each may start at any node.
    budgets : (r,) array
        Longest way of each robot, metres; may be infinite; at least straight to its end.
    ends : (r, d) array, optional
        Where the way of each robot has to end, metres; not a number: anywhere.
    speeds : (r,) array, optional
        Of the robots, on any common scale; none: all alike.
    known : list of (m,) arrays, optional
        Paths to improve, in addition to new ones; nodes that are not on them are added. Where they
        keep to the budgets, the result never collects less than they do.
    """
    used, robots = np.flatnonzero(np.asarray(prizes) > 0.0), len(budgets)
    endless = bool(np.isinf(budgets).any())
    if len(used) > (MOST if endless else 1):
        gaps = cKDTree(nodes[used]).query(nodes[used], 2)[0][:, 1]
        gap = max(float(np.median(gaps)), 1e-9)
        # Without a budget a robot reaches its share of the most nodes.
        reach = np.where(np.isinf(budgets), MOST * gap / robots, budgets)
        number = MOST if endless else min(int(CHOICE * np.sum(reach) / gap) + 1, MOST)
        if number < len(used):
            far = 0.0 if starts is None else cKDTree(starts).query(nodes[used])[0]
            best = np.argsort(-prizes[used] / (np.mean(reach) + far), kind='stable')[:number]
            best = used[best] if known is None else np.concatenate([used[best], *known])
            used = used[np.isin(used, best)]
    n, d = len(used), np.shape(nodes)[1]
    if n == 0:
        return [used] * robots
    points, free = np.zeros((n + 2 * robots + 2, d)), np.ones(n + 2 * robots + 2, np.bool_)
    points[:n], free[:n] = nodes[used], False
    for first, given in ((n, starts), (n + robots + 1, ends)):
        if given is not None:
            fixed = np.asarray(np.isfinite(given).all(axis=1))
            points[first : first + robots] = np.where(fixed[:, None], given, 0.0)
            free[first : first + robots] = ~fixed
    prize = np.zeros(len(points))
    prize[:n] = prizes[used]
    places = _Places(points, free, prize, _nearest(points, free, n, min(NEIGHBOURS, n)))
    rates = np.ones(robots) if speeds is None else 1.0 / np.asarray(speeds, dtype=float)
    # The way to the end is gone in any case.
    direct = [_gap(points, free, n + k, n + robots + 1 + k) for k in range(robots)]
    limits = np.maximum(budgets, direct)
    early = _terms(limits, rate=rates)
    begun, old = [], [used[:0]] * robots
    if known is not None and any(map(len, known)):
        old = [np.searchsorted(used, way[np.isin(way, used)]) for way in known]
        begun.append(_completed(places, old))
    for axes in (np.arange(d), np.array([1, 0, *range(2, d)])):
        begun.append(_shared(places, _lanes(points[:n][:, axes]), robots))
    routes, least = _routes(places, begun[0]), math.inf
    for rows in begun:
        found = _routes(places, rows)
        _improve(places, found, early)
        cost = sum(_now(found, early, k) for k in range(robots))
        # Of equal ones the first: known ways, or straight ones.
        if cost < (1.0 - 1e-6) * least:
            routes, least = found, cost
    if (routes.lengths() > limits).any():
        routes = _within(places, routes, _routes(places, old), limits, rates)
    return [used[row] for row in routes.visited()]


def _terms(
    limits: FloatArray,
    price: float | FloatArray = 0.0,
    rate: float | FloatArray = 0.0,
    worth: float = 0.0,
    over: float = 0.0,
) -> FloatArray:
    """Return what counts in the cost of each route (r + 1, 5); of the last one nothing.

    price of a metre, rate of prize times way, worth of prize, limit of the way, price beyond it.
    """
    terms = np.zeros((len(limits) + 1, 5))
    terms[:-1] = np.stack(np.broadcast_arrays(price, rate, worth, limits, over), axis=1)
    return terms


def _lanes(points: FloatArray) -> IntArray:
    """Return the order of points (n, d) in lanes along the first axis, in layers along the last."""
    low = points.min(axis=0)
    size = points.max(axis=0) - low
    size = size[size > 1e-9 * size.max()]
    pitch = max((size.prod() / len(points)) ** (1.0 / max(len(size), 1)), 1e-9)
    rows = np.round((points - low) / pitch).astype(np.int64)
    lane = rows[:, 1]
    if points.shape[1] == 3:
        turned = np.where(rows[:, 2] % 2, lane.max() - lane, lane)
        lane = rows[:, 2] * (lane.max() + 1) + turned
    _, lane = np.unique(lane, return_inverse=True)
    return np.lexsort((np.where(lane % 2, -points[:, 0], points[:, 0]), lane))


def _shared(places: _Places, order: IntArray, robots: int) -> list[IntArray]:
    """Return equal parts of an order of nodes, each robot that which begins or ends nearest."""
    parts, rows = np.array_split(order, robots), []
    for start in range(len(order), len(order) + robots):
        gaps = [
            [_gap(places.points, places.free, start, end) for end in part[[0, -1]]]
            if len(part)
            else [math.inf] * 2
            for part in parts
        ]
        nearest = min(range(len(parts)), key=lambda i: min(gaps[i]))
        part, gap = parts.pop(nearest), gaps[nearest]
        rows.append(part[::-1] if gap[1] < gap[0] else part)
    return rows


def _completed(places: _Places, rows: list[IntArray]) -> list[IntArray]:
    """Return rows with the nodes that are on none, each behind its nearest one that is on one."""
    ways = [row.tolist() for row in rows]
    on = {node: way for way in ways for node in way}
    for node in range(len(places.near) - len(rows) - 1):
        if node not in on:
            near = next((other for other in places.near[node].tolist() if other in on), None)
            on[node] = on[near] if near is not None else min(ways, key=len)
            on[node].insert(on[node].index(near) + 1 if near is not None else 0, node)
    return [np.array(way, np.int64) for way in ways]


def _routes(places: _Places, rows: list[IntArray]) -> _Routes:
    """Return routes with the nodes of each robot; the other nodes are in the last one."""
    n, number = len(places.near) - len(rows) - 1, len(rows) + 1
    left = np.setdiff1d(np.arange(n), np.concatenate(rows))
    sums = np.zeros((3, number, n + 3))
    where = np.zeros((len(places.points), 2), np.int64)
    routes = _Routes(np.zeros((number, n + 3), np.int64), np.zeros(number, int), where, *sums)
    for k, row in enumerate([*rows, left]):
        _take(places, routes, k, np.array([n + k, *row, n + number + k], np.int64))
    return routes


def _within(
    places: _Places, routes: _Routes, known: _Routes, limits: FloatArray, rates: FloatArray
) -> _Routes:
    """Return routes within limits [m]: a price of each robot's metres is adapted to them.

    After each round what does not fit is dropped, and what fits is added. Known routes that fit are
    the first candidate, as they are and improved.
    """
    usual = places.prizes.sum() / max(routes.lengths().sum(), 1e-9)
    size = 0.01 / max(routes.lengths().max(), 1e-9)
    fit = _terms(limits, 0.01 * usual, size * rates / rates.max(), 1.0, 1e4 * usual)
    price, low = np.full(len(limits), usual), np.zeros(len(limits))
    high = np.full(len(limits), np.inf)
    # First the part of ways that collect all early which fits.
    rows = [row[: _reach(places, routes, k, limits[k])] for k, row in enumerate(routes.visited())]
    best, most = _routes(places, rows), -1.0
    for k in range(-2, ROUNDS):
        fitted = _routes(places, known.visited() if k < 0 else rows)
        if k > -2:
            _improve(places, fitted, fit)
        collected = sum(places.prizes[row].sum() for row in fitted.visited())
        if collected > most and (fitted.lengths() <= limits).all():
            best, most = fitted, collected
        if k < 0:
            continue
        _improve(places, routes, _terms(limits, price, worth=1.0))
        rows, over = routes.visited(), routes.lengths() > limits
        low, high = np.where(over, price, low), np.where(over, high, price)
        middle = np.sqrt(low * np.minimum(high, 1e300))
        price = np.where(high == np.inf, 2.0 * price, np.where(low, middle, 0.5 * price))
    return best


def _reach(places: _Places, routes: _Routes, k: int, limit: float) -> int:
    """Return how many nodes of a route can be visited within a limit [m]."""
    number = int(routes.counts[k])
    end = int(routes.order[k, number + 1])
    while number and limit < routes.ways[k, number] + _gap(
        places.points, places.free, routes.order[k, number], end
    ):
        number -= 1
    return number


@njit(cache=True)
def _gap(points, free, a, b):  # type: ignore[no-untyped-def]
    if free[a] or free[b]:
        return 0.0
    total = 0.0
    for axis in range(points.shape[1]):
        total += (points[a, axis] - points[b, axis]) ** 2
    return math.sqrt(total)


@njit(cache=True)
def _nearest(points, free, n, number):  # type: ignore[no-untyped-def]
    """Return the nearest nodes of each node and start; -1: none."""
    near = np.full(((len(points) + n) // 2, number), -1)
    gaps = np.empty(number)
    for a in range(len(near)):
        gaps[:] = np.inf
        for b in range(n):
            gap = _gap(points, free, a, b)
            if free[a] or b == a or gap >= gaps[number - 1]:
                continue
            i = number - 1
            while i > 0 and gaps[i - 1] > gap:
                gaps[i], near[a, i] = gaps[i - 1], near[a, i - 1]
                i -= 1
            gaps[i], near[a, i] = gap, b
    return near


@njit(cache=True)
def _take(places, routes, k, row):  # type: ignore[no-untyped-def]
    """Replace a route, and add up along it."""
    routes.counts[k] = len(row) - 2
    way = total = late = 0.0
    for i in range(len(row)):
        if i > 0:
            way += _gap(places.points, places.free, row[i - 1], row[i])
        routes.order[k, i] = row[i]
        routes.where[row[i], 0], routes.where[row[i], 1] = k, i
        routes.ways[k, i], routes.sums[k, i], routes.moments[k, i] = way, total, late
        total += places.prizes[row[i]]
        late += places.prizes[row[i]] * way
    # Ends have no prize: the sums before the end are those of the whole route.


@njit(cache=True)
def _weighed(term, length, late, prize):  # type: ignore[no-untyped-def]
    over = max(length - term[3], 0.0)
    return term[0] * length + term[1] * late - term[2] * prize + term[4] * over


@njit(cache=True)
def _now(routes, terms, k):  # type: ignore[no-untyped-def]
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
            length += _gap(places.points, places.free, end, first)
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
        # Nodes x to y move behind place q: j beside i, before or behind it, forwards or backwards.
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
def _joined(routes, parts, active):  # type: ignore[no-untyped-def]
    """Return the places of parts in order, and mark where they begin and end as active."""
    row = np.empty(routes.order.shape[1], np.int64)
    length = 0
    for k, i, j, back in parts:
        for step in range(j - i + 1):
            row[length] = routes.order[k, j - step if back else i + step]
            active[row[length]] |= step == 0 or step == j - i
            length += 1
    return row[:length]


@njit(cache=True)
def _improve(places, routes, terms):  # type: ignore[no-untyped-def]
    """Make the best move at each place until none makes the routes cheaper."""
    # Less is the rounding of sums that cancel.
    least = 1e-9 * np.abs(terms[:, 2]).max() * places.prizes.sum()
    for k in range(len(terms)):
        end = routes.counts[k] + 1
        least += 1e-9 * terms[k, 0] * routes.ways[k, end]
        least += 1e-9 * terms[k, 1] * routes.moments[k, end]
    active = np.ones(len(places.points), np.bool_)
    while active[: len(places.near)].any():
        for a in range(len(places.near)):
            while active[a]:
                active[a] = False
                kind, k, i, h, j = _best_move(places, routes, terms, least, a)
                if kind >= 0:
                    first, second = _move(kind, routes.counts, k, i, h, j)
                    one, other = _joined(routes, first, active), _joined(routes, second, active)
                    _take(places, routes, k, one)
                    if k != h:
                        _take(places, routes, h, other)
                    active[a] = True


@njit(cache=True)
def _best_move(places, routes, terms, least, a):  # type: ignore[no-untyped-def]
    """Return the best move that connects a place with a near node, or drops it; -1: none."""
    best, chosen = least, (-1, 0, 0, 0, 0)
    unused = len(terms) - 1
    # Where prizes are worth nothing, all nodes are visited.
    for rank in range(places.near.shape[1] + (terms[0, 2] > 0.0)):
        k, i = routes.where[a]
        if rank < places.near.shape[1]:
            b = places.near[a, rank]
            if b < 0:
                continue
            h, j = routes.where[b]
        else:
            h, j = k, i
            k, i = unused, 0
        if (k == h and k == unused) or j < 1:
            continue
        before = _now(routes, terms, k)
        if k != h:
            before += _now(routes, terms, h)
        for kind in range(4 * LONGEST + 2):
            first, second = _move(kind, routes.counts, k, i, h, j)
            if first[0][1] > first[0][2]:
                continue
            after = _cost(places, routes, first, terms[k])
            if k != h:
                after += _cost(places, routes, second, terms[h])
            if before - after > best:
                best, chosen = before - after, (kind, k, i, h, j)
    return chosen
