"""Paths of a team that collect prizes within budgets, or all of them early.

A local search (`routes.py`) improves paths. To leave its optima, each try removes stretches of
nodes near a random one, or forces nodes in and drops what has the least prize for its metres; then
what fits is added. A worse result is accepted less and less often (simulated annealing).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.planners.routes import (
    Places,
    Routes,
    best_entry,
    cost_now,
    draw,
    entry_cost,
    gap_between,
    improve,
    insert,
    make_routes,
    remove,
    restore,
)

# Nearest nodes that moves connect.
NEIGHBOURS = 8
# Within budgets the best nodes are considered: so many times those that can be visited, and never
# more than so many.
CHOICE, MOST = 1.2, 2000
# Tries for each node and at most: within budgets, and without.
TRIES, TRIES_EARLY = (20, 2000), (1, 800)
# A try removes up to so many stretches of so many nodes; or, with this chance, forces nodes in.
STRETCHES, STRETCH, FORCED = 3, 10, 0.4
# Temperature at first and at last, in mean prizes or in mean costs of a node.
HOT, COLD, HOT_EARLY, COLD_EARLY = 1.0, 0.1, 0.3, 0.003
# Of the mean prize of a metre: the price of a metre, and the worth of one that is saved.
PRICE, CREDIT = 0.05, 0.5
# Price of a metre beyond the limit, in mean prizes of a metre.
OVER = 1e4
# Random part of scores, and places of a route at which a stretch to drop may begin.
NOISE, WINDOW = 0.3, 200


def plan_routes(
    nodes: FloatArray,
    prizes: FloatArray,
    starts: FloatArray | None,
    budgets: FloatArray,
    ends: FloatArray | None = None,
    speeds: FloatArray | None = None,
    known: list[IntArray] | None = None,
    effort: float = 1.0,
    worths: FloatArray | None = None,
) -> list[IntArray]:
    """Return the nodes that each robot visits, in order.

    Within the budgets as much prize as possible is collected. Where they suffice for all nodes
    with a prize, those are visited so that the sum of prize times arrival is small.

    Parameters
    ----------
    nodes : (n, d) array
        Positions to visit, metres.
    prizes : (n,) array
        What a visit is worth, from 0.
    starts : (r, d) array or None
        Where robots are, metres; None: each may start at any node.
    budgets : (r,) array
        Longest path of each robot, metres; may be infinite; at least straight to its end.
    ends : (r, d) array, optional
        Where the path of each robot has to end, metres; not a number: anywhere.
    speeds : (r,) array, optional
        Of the robots, on any common scale; none: all alike.
    known : list of (m,) arrays, optional
        Paths to improve, in addition to new ones; nodes that are not on them are added. Where they
        keep to the budgets, the result never collects less than they do.
    effort : float, optional
        Factor on the number of tries of the search.
    worths : (r,) array, optional
        Share of a prize that each robot gains, 0 to 1, first those with 1; default: 1. Rows with
        less are later flights, which are used where the present ones do not suffice.
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
    points, free = np.zeros((n + 2 * robots, 3)), np.ones(n + 2 * robots, np.bool_)
    points[:n, :d], free[:n] = nodes[used], False
    for first, given in ((n, starts), (n + robots, ends)):
        if given is not None:
            fixed = np.asarray(np.isfinite(given).all(axis=1))
            points[first : first + robots, :d] = np.where(fixed[:, None], given, 0.0)
            free[first : first + robots] = ~fixed
    prize = np.zeros(len(points))
    prize[:n] = prizes[used]
    places = Places(points, free, prize, _nearest(points, free, n, n + robots))
    rates = np.ones(robots) if speeds is None else 1.0 / np.asarray(speeds, dtype=float)
    # A robot moves to its end in any case.
    direct = [gap_between(points, free, n + k, n + robots + k) for k in range(robots)]
    limits = np.maximum(budgets, direct) * (1.0 + 1e-12)
    worth = np.ones(robots) if worths is None else worths
    present = int((worth == 1.0).sum())
    now = np.where(worth == 1.0, limits, 0.0)
    early = _terms(now, 0.0, rates, 0.0, OVER * prize.sum() * rates.max())
    old = [used[:0]] * robots
    if known is not None:
        old = [np.searchsorted(used, path[np.isin(path, used)]) for path in known]
    begun = _begin(places, old, present, d)
    # A node has two legs, each at least as long as to the nearest node.
    legs = np.zeros(n)
    if n > 1:
        legs = np.sort(np.linalg.norm(points[:n] - points[places.near[:n, 0]], axis=1))
    whole = bool(legs[: max(n - robots, 0)].sum() <= now.sum())
    if whole:
        for found in begun:
            _put(places, found, early, np.arange(n))
            improve(places, found, early, True)
        costs = [sum(cost_now(found, early, k) for k in range(robots)) for found in begun]
        # Of equal ones the first: known paths, or straight ones.
        first = next(i for i, cost in enumerate(costs) if cost <= min(costs) * (1.0 + 1e-6))
        routes = begun[first]
        whole = bool((routes.lengths() <= now).all())
    if not whole:
        if present < robots:
            begun = _begin(places, old, robots, d)
        terms = _terms(limits, PRICE, 0.0, worth, OVER)
        routes = _within(places, begun, make_routes(places, old), terms, rates, effort)
    if whole or (present == robots and routes.counts.sum() == n):
        heat = max(sum(cost_now(routes, early, k) for k in range(robots)) / n, 1e-300)
        tries = int(effort * min(TRIES_EARLY[0] * n, TRIES_EARLY[1]))
        _search(places, routes, early, tries, HOT_EARLY * heat, COLD_EARLY * heat)
    return [used[row] for row in routes.visited()]


def _terms(
    limits: FloatArray,
    price: float,
    rate: float | FloatArray,
    worth: float | FloatArray,
    over: float,
) -> FloatArray:
    """Return what counts in the cost of each route (r, 5).

    Columns: price of a metre, rate of prize times distance to it, worth of prize, limit of the
    length, price of a metre beyond it.
    """
    return np.stack(np.broadcast_arrays(price, rate, worth, limits, over), axis=1)


def _begin(places: Places, known: list[IntArray], present: int, dimension: int) -> list[Routes]:
    """Return known routes, and lanes along two axes that the present robots share."""
    robots = len(known)
    n = len(places.near) - robots
    found = [known] if any(map(len, known)) else []
    for axes in (np.arange(dimension), np.array([1, 0, *range(2, dimension)])):
        lanes = _shared(places, _lanes(places.points[:n][:, axes]), present)
        found.append(lanes + [lanes[0][:0]] * (robots - present))
    return [make_routes(places, rows) for rows in found]


def _within(
    places: Places,
    begun: list[Routes],
    known: Routes,
    terms: FloatArray,
    rates: FloatArray,
    effort: float,
) -> Routes:
    """Return routes within limits: the best of begun and known ones, after a search.

    terms: prices of metres are in mean prizes of a metre.
    """
    robots, n = len(terms), len(places.near) - len(terms)
    limits, worth = terms[:, 3], terms[:, 2]
    longest = max(max(found.lengths().max() for found in begun), 1e-9)
    usual = places.prizes.sum() / max(begun[-1].lengths().sum(), 1e-9)
    terms = terms * [usual, 1.0, 1.0, 1.0, usual]
    start, least = known, math.inf
    empty = make_routes(places, [np.zeros(0, np.int64)] * robots)
    for rows in (known, *begun, empty):
        found = make_routes(places, rows.visited())
        _drop(places, found, terms, 0.0)
        _collect(places, found, terms, np.flatnonzero(found.where[:n, 0] < 0))
        improve(places, found, terms, True)
        cost = sum(cost_now(found, terms, k) for k in range(robots))
        if cost < least:
            start, least = found, cost
    mean = float(np.sort(places.prizes)[-max(int(start.counts.sum()), 1) :].mean())
    tries = int(effort * min(TRIES[0] * n, TRIES[1]))
    _search(places, start, terms, tries, HOT * mean, COLD * mean)
    if (known.lengths() <= limits).all():
        gained, had = (
            sum(w * places.prizes[row].sum() for w, row in zip(worth, found.visited()))
            for found in (start, known)
        )
        if gained <= had:
            return known
    # In an order in which they are collected early.
    rate = 0.01 / longest * rates / rates.max()
    improve(places, start, _terms(limits, 0.01 * usual, rate, worth, OVER * usual), True)
    return start


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


def _shared(places: Places, order: IntArray, robots: int) -> list[IntArray]:
    """Return equal parts of an order of nodes, for each robot the one with the nearest end."""
    parts, rows = np.array_split(order, robots), []
    for start in range(len(order), len(order) + robots):
        gaps = [
            [gap_between(places.points, places.free, start, end) for end in part[[0, -1]]]
            if len(part)
            else [math.inf] * 2
            for part in parts
        ]
        nearest = min(range(len(parts)), key=lambda i: min(gaps[i]))
        part, gap = parts.pop(nearest), gaps[nearest]
        rows.append(part[::-1] if gap[1] < gap[0] else part)
    return rows


def _nearest(points: FloatArray, free: BoolArray, n: int, number: int) -> IntArray:
    """Return the nearest nodes of each of a number of places; -1: none."""
    near = np.full((number, min(NEIGHBOURS, n)), -1)
    rows = np.flatnonzero(~free[:number])
    found = cKDTree(points[:n]).query(points[rows], [*range(1, min(NEIGHBOURS + 1, n) + 1)])[1]
    for row, nodes in zip(rows, found):
        others = nodes[nodes != row][:NEIGHBOURS]
        near[row, : len(others)] = others
    return near


@njit(cache=True)
def _put(places, routes, terms, nodes):  # type: ignore[no-untyped-def]
    """Insert each node that is on no route where that is cheapest, whatever the limits are."""
    for v in nodes:
        if routes.where[v, 0] < 0:
            _, k, i = best_entry(places, routes, terms, v, False)
            insert(places, routes, k, i, v)


@njit(cache=True)
def _drop(places, routes, terms, credit):  # type: ignore[no-untyped-def]
    """Remove stretches of least prize for their metres until the routes are within limits."""
    for k in range(len(terms)):
        ways, sums = routes.ways[k], routes.sums[k]
        while routes.counts[k] and ways[routes.counts[k] + 1] > terms[k, 3]:
            count, best, first, length = routes.counts[k], math.inf, 1, routes.counts[k]
            over = ways[count + 1] - terms[k, 3]
            low = int(draw(routes) * count) if count > WINDOW else 0
            for step in range(min(count, WINDOW)):
                i, number, saved = 1 + (low + step) % count, 1, 0.0
                while i + number <= count + 1 and saved <= 2.0 * over:
                    a, b = routes.order[k, i - 1], routes.order[k, i + number]
                    saved = ways[i + number] - ways[i - 1]
                    saved -= gap_between(places.points, places.free, a, b)
                    if saved > 1e-12:
                        score = sums[i + number] - sums[i] - credit * max(saved - over, 0.0)
                        score *= (1.0 + NOISE * draw(routes)) / min(saved, over)
                        if score < best:
                            best, first, length = score, i, number
                    number += 1 + number // 2
            remove(places, routes, k, first, length)


@njit(cache=True)
def _collect(places, routes, terms, nodes):  # type: ignore[no-untyped-def]
    """Insert nodes one by one, that of most prize for its cost first, as long as one fits."""
    m, power = len(nodes), 0.5 + draw(routes)
    worth, score, behind = np.empty(m), np.full(m, -1.0), np.empty(m, np.int64)
    k, i, fresh = -1, 0, True
    while m:
        for u, v in enumerate(nodes):
            if fresh:
                worth[u] = (places.prizes[v] * (1.0 - NOISE * draw(routes))) ** power
            elif score[u] < 0.0 or k < 0:
                continue
            if fresh or behind[u] == routes.order[k, i]:
                # The route has changed where the node was cheapest.
                cost, h, j = best_entry(places, routes, terms, v, True)
                score[u] = worth[u] / cost if h >= 0 else -1.0
                behind[u] = routes.order[h, j]
            else:
                for j in (i, i + 1):
                    cost = entry_cost(places, routes, terms[k], k, j, v, True)
                    if worth[u] > score[u] * cost:
                        score[u], behind[u] = worth[u] / cost, routes.order[k, j]
        fresh, u = False, int(np.argmax(score))
        if score[u] < 0.0:
            break
        k, i = routes.where[behind[u]]
        if entry_cost(places, routes, terms[k], k, i, nodes[u], True) == math.inf:
            _, k, i = best_entry(places, routes, terms, nodes[u], True)
        score[u] = -1.0
        if k >= 0:
            insert(places, routes, k, i, nodes[u])


@njit(cache=True)
def _spread(places, routes, seen, stamp, rings, most):  # type: ignore[no-untyped-def]
    """Return the loose nodes, and those on no route up to so many neighbours away from them."""
    nodes, size, at = np.empty(len(seen), np.int64), routes.loose[-1], 0
    nodes[:size] = routes.loose[:size]
    seen[nodes[:size]] = stamp
    for _ in range(rings):
        for u in range(at, size):
            at += 1
            for b in places.near[nodes[u]]:
                if b >= 0 and size < most and seen[b] != stamp and routes.where[b, 0] < 0:
                    seen[b] = stamp
                    nodes[size] = b
                    size += 1
    return nodes[:size]


@njit(cache=True)
def _search(places, routes, terms, tries, hot, cold):  # type: ignore[no-untyped-def]
    """Replace routes by the best ones of a number of tries."""
    near, robots, soft = places.near, len(terms), terms.copy()
    n, every = len(near) - robots, terms[0, 2] == 0.0
    soft[:, 4] /= OVER
    seen, cost, way, prize = np.zeros(n, np.int64), 0.0, 0.0, 0.0
    for k in range(robots):
        cost += cost_now(routes, terms, k)
        way += routes.ways[k, routes.counts[k] + 1]
        prize += routes.sums[k, routes.counts[k] + 1]
    credit, least = CREDIT * prize / max(way, 1e-9), 1e-7 * abs(cost)
    best, order, counts = cost, routes.order.copy(), routes.counts.copy()
    for attempt in range(tries):
        routes.touched[:] = False
        routes.loose[-1] = 0
        centre = int(draw(routes) * n)
        if not every and draw(routes) < FORCED:
            # A chain of nodes is forced in.
            routes.loose[0], routes.loose[-1] = centre, 1
            most = 1 + int((0.2 * n + 2.0) ** (draw(routes) ** 2))
            chain = _spread(places, routes, seen, 2 * attempt + 1, most, most)
            _put(places, routes, terms, chain)
            improve(places, routes, soft, False)
            routes.loose[-1] = 0
            _drop(places, routes, terms, credit)
        else:
            left, longest = 1 + int(draw(routes) * STRETCHES), 1 + int(draw(routes) * STRETCH)
            for rank in range(-1, near.shape[1]):
                v = centre if rank < 0 else near[centre, rank]
                if v < 0 or left == 0 or routes.where[v, 0] < 0:
                    continue
                k, i = routes.where[v]
                number = min(1 + int(draw(routes) * longest), routes.counts[k])
                low, high = max(1, i - number + 1), min(i, routes.counts[k] - number + 1)
                remove(places, routes, k, low + int(draw(routes) * (high - low + 1)), number)
                left -= 1
            if routes.loose[-1] == 0:
                routes.loose[0], routes.loose[-1] = centre, 1
        nodes = _spread(places, routes, seen, 2 * attempt + 2, 1, n)
        if every:
            keys = np.empty(len(nodes))
            for u in range(len(nodes)):
                keys[u] = draw(routes)
            _put(places, routes, terms, nodes[np.argsort(keys)])
        else:
            _collect(places, routes, terms, nodes)
        improve(places, routes, terms, False)
        before, cost, heat = cost, 0.0, hot * (cold / hot) ** (attempt / tries)
        for k in range(robots):
            cost += cost_now(routes, terms, k)
        if cost - before > -heat * math.log(1.0 - draw(routes)):
            cost = before
            restore(places, routes, routes.kept, routes.numbers)
        elif cost < best - least:
            best = cost
            order[:], counts[:] = routes.order, routes.counts
    routes.touched[:] = True
    restore(places, routes, order, counts)
