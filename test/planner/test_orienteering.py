"""Ways that collect prizes: against brute force on small cases, budgets, and teams."""

import itertools

import numpy as np
import pytest

from maasi_planner.planners.orienteering import MOST, plan_routes


def arrivals(points, start, path, end=None):
    """Return the distances to the nodes of a path, and its length [m]."""
    places = [*([] if start is None else [start]), *points[path], *([] if end is None else [end])]
    gaps = np.linalg.norm(np.diff(places, axis=0), axis=1) if len(places) > 1 else np.zeros(0)
    passed = np.cumsum([*([0.0] if start is None else []), *gaps])
    return passed[: len(path)], passed[-1] if len(passed) else 0.0


def drawn(seed, number=6, dimension=2):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.0, 1.0, (number, dimension)), rng.uniform(0.1, 1.0, number), rng


@pytest.mark.parametrize('dimension', [2, 3])
def test_without_budget_prizes_come_early(dimension):
    """The mean time to a prize is close to the least of all orders, and mostly equal to it."""
    ratios = []
    for seed in range(15):
        points, prizes, rng = drawn(seed, dimension=dimension)
        start = rng.uniform(0.0, 1.0, dimension)

        def late(path, points=points, prizes=prizes, start=start):
            return float(prizes[list(path)] @ arrivals(points, start, list(path))[0])

        least = min(late(path) for path in itertools.permutations(range(6)))
        (path,) = plan_routes(points, prizes, start[None, :], np.array([np.inf]))
        assert sorted(path) == list(range(6))
        ratios.append(late(path) / least)
    assert max(ratios) < 1.1 and np.median(ratios) == pytest.approx(1.0)


@pytest.mark.parametrize('home', [False, True])
@pytest.mark.parametrize('free', [False, True])
def test_budgets_are_kept_and_prizes_are_close_to_the_most(home, free):
    ratios = []
    for seed in range(15):
        points, prizes, rng = drawn(seed)
        start, end, budget = *rng.uniform(0.0, 1.0, (2, 2)), rng.uniform(0.7, 2.0)
        start, end = None if free else start, end if home else None
        most = 0.0
        for size in range(7):
            for path in itertools.permutations(range(6), size):
                if arrivals(points, start, list(path), end)[1] <= budget:
                    most = max(most, prizes[list(path)].sum())
        given = [None if place is None else place[None, :] for place in (start, end)]
        (path,) = plan_routes(points, prizes, given[0], np.array([budget]), given[1])
        if len(path):
            assert arrivals(points, start, path, end)[1] <= budget + 1e-9
        ratios.append(prizes[path].sum() / max(most, 1e-9) if most else 1.0)
    assert min(ratios) > 0.8 and np.median(ratios) == pytest.approx(1.0)


def lattice(rows, columns):
    return np.stack(np.meshgrid(range(columns), range(rows)), axis=-1).reshape(-1, 2) + 0.5


@pytest.mark.parametrize('robots', [1, 3])
def test_a_team_shares_a_field_in_lanes(robots):
    points = lattice(12, 15)
    starts = np.random.default_rng(3).uniform(0.0, 12.0, (robots, 2))
    paths = plan_routes(points, np.ones(180), starts, np.full(robots, np.inf))
    assert sorted(np.concatenate(paths)) == list(range(180))
    mean = np.mean(np.concatenate([arrivals(points, s, path)[0] for s, path in zip(starts, paths)]))
    assert mean < 1.06 * 90.0 / robots
    again = plan_routes(points, np.ones(180), starts, np.full(robots, np.inf))
    assert all(np.array_equal(*pair) for pair in zip(paths, again))


def test_a_budget_is_spent_where_the_prizes_are():
    points = lattice(20, 20)
    prizes = np.exp(-((points - [4.0, 14.0]) ** 2).sum(axis=1) / 20.0)
    starts, budgets = np.array([[10.0, 10.0], [0.0, 0.0]]), np.array([60.0, 40.0])
    paths = plan_routes(points, prizes, starts, budgets, starts)
    for start, path, budget in zip(starts, paths, budgets):
        assert arrivals(points, start, path, start)[1] <= budget
    best = np.sort(prizes)[::-1][:70].sum()
    assert prizes[np.concatenate(paths)].sum() > 0.85 * best


def test_a_faster_robot_does_more_and_none_without_prizes():
    points, starts = lattice(10, 10), np.array([[0.0, 5.0], [10.0, 5.0]])
    fast, slow = plan_routes(
        points, np.ones(100), starts, np.full(2, np.inf), speeds=np.array([3.0, 1.0])
    )
    assert 65 < len(fast) < 85 and len(slow) == 100 - len(fast)
    assert [len(path) for path in plan_routes(points, np.zeros(100), starts, np.ones(2))] == [0, 0]
    one = plan_routes(points[:1], np.ones(1), starts, np.full(2, np.inf))
    assert [len(path) for path in one] == [1, 0]


def test_small_budgets_on_a_lattice_end_within_them():
    points = 20.0 * lattice(4, 5)
    for seed in range(50):
        rng = np.random.default_rng(seed)
        start, budget = points[7:8] + 0.5, rng.uniform(20.0, 120.0)
        prizes = 0.1 * rng.random(len(points))
        (path,) = plan_routes(points, prizes, start, np.array([budget]), points[:1])
        # The path home is gone in any case.
        most = max(budget, np.linalg.norm(points[0] - start[0]))
        assert arrivals(points, start[0], path, points[0])[1] <= most + 1e-9


def test_of_equal_ways_the_known_ones_are_kept():
    points, prizes, budget = lattice(6, 6), np.ones(36), np.array([np.inf])
    start = points[:1] - 0.5
    (lanes,) = plan_routes(points, prizes, start, budget)
    across = lanes % 6 * 6 + lanes // 6
    for known in (lanes, across):
        (path,) = plan_routes(points, prizes, start, budget, known=[known])
        assert path.tolist() == known.tolist()
        (path,) = plan_routes(points, prizes, start, budget, known=[known[:20]])
        assert sorted(path) == list(range(36))


def test_only_some_robots_have_to_end_somewhere():
    """A row of ends that is not a number, and an infinite budget, are no limit for that robot."""
    for seed in range(12):
        points, prizes, rng = drawn(seed, 30)
        starts, end = rng.uniform(0.0, 1.0, (2, 2)), rng.uniform(0.0, 1.0, 2)
        budget = 1.5 + np.linalg.norm(end - starts[0])
        ends = np.array([end, [np.nan, np.nan]])
        mine, other = plan_routes(points, prizes, starts, np.array([budget, np.inf]), ends)
        assert sorted([*mine, *other]) == list(range(30))
        assert arrivals(points, starts[0], mine, end)[1] <= budget + 1e-9
        # Alone with a limit, some are left.
        limits = np.array([budget, 1.0])
        mine, other = plan_routes(points, prizes, starts, limits, ends)
        assert arrivals(points, starts[0], mine, end)[1] <= budget + 1e-9
        assert arrivals(points, starts[1], other)[1] <= 1.0 + 1e-9
        assert 4 < len(mine) + len(other) < 30


def test_of_many_nodes_the_best_for_their_distance_are_planned():
    nodes = np.stack(np.meshgrid(*2 * [np.arange(100.0)]), axis=-1).reshape(-1, 2)
    prizes = np.full(len(nodes), 0.01)
    prizes[nodes[:, 0] + nodes[:, 1] > 180.0] = 1.0
    starts = np.array([[0.0, 0.0], [0.0, 99.0]])
    paths = plan_routes(nodes, prizes, starts, np.full(2, np.inf))
    visited = np.concatenate(paths)
    assert len(visited) == len(set(visited.tolist())) == MOST
    assert set(np.flatnonzero(prizes == 1.0)) <= set(visited.tolist())
    # Of the others those that are near.
    gaps = np.linalg.norm(nodes[:, None] - starts, axis=2).min(axis=1)
    assert gaps[visited][prizes[visited] < 1.0].max() < 60.0


def test_a_new_plan_never_collects_less_than_the_rest_of_the_old_one():
    """After 20, 40 and 60 % of the paths the rest of them is a known solution that fits."""
    gains = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rows, columns, robots = *rng.integers(4, 8, 2), rng.integers(1, 4)
        points, hot = lattice(rows, columns), rng.uniform(0.0, rows, (2, 2))
        gaps = np.linalg.norm(points[:, None] - hot, axis=2)
        prizes = np.exp(-(gaps**2) / 4.0).sum(axis=1) + 0.02 * rng.random(len(points))
        starts = rng.uniform(0.0, rows, (robots, 2))
        budgets = rng.uniform(0.2, 0.8, robots) * len(points) / robots
        ends = starts if seed % 2 else None
        homes = starts if seed % 2 else [None] * robots
        paths = plan_routes(points, prizes, starts, budgets, ends, effort=0.1)
        for share in (0.2, 0.4, 0.6):
            here, left, rest = starts.copy(), budgets.copy(), []
            for k, path in enumerate(paths):
                done = int(share * len(path))
                if done:
                    here[k] = points[path[done - 1]]
                    left[k] -= arrivals(points, starts[k], path[:done])[1]
                rest.append(path[done:])
            now = prizes.copy()
            now[[node for path, old in zip(paths, rest) for node in path if node not in old]] = 0.0
            again = plan_routes(points, now, here, left, ends, known=rest, effort=0.1)
            visited = np.concatenate(again)
            assert len(visited) == len(set(visited.tolist()))
            for k, path in enumerate(again):
                most = max(left[k], 0.0 if homes[k] is None else np.hypot(*(homes[k] - here[k])))
                assert arrivals(points, here[k], path, homes[k])[1] <= most + 1e-9
            before = now[np.concatenate(rest)].sum()
            gains.append(now[visited].sum() - before)
            assert gains[-1] >= -1e-9 * prizes.sum()
    assert np.mean(gains) > 0.0


@pytest.mark.parametrize('seed', range(20))
def test_later_flights_are_used_where_the_present_ones_do_not_suffice(seed):
    rng = np.random.default_rng(seed)
    robots, points = int(rng.integers(1, 4)), lattice(*rng.integers(4, 8, 2))
    homes = rng.uniform(0.0, 4.0, (robots, 2))
    starts = np.concatenate([rng.uniform(0.0, 4.0, (robots, 2)), homes])
    ends, worths = np.concatenate([homes, homes]), np.repeat([1.0, 0.6], robots)
    enough = np.full(robots, 3.0 * len(points))
    for present in (enough, rng.uniform(0.0, 0.6, robots) * len(points) / robots):
        budgets = np.concatenate([present, rng.uniform(0.5, 1.5, robots) * len(points) / robots])
        paths = plan_routes(points, np.ones(len(points)), starts, budgets, ends, worths=worths)
        visited = np.concatenate(paths)
        assert len(visited) == len(set(visited.tolist()))
        for start, path, budget, end in zip(starts, paths, budgets, ends):
            most = max(budget, np.hypot(*(end - start)))
            assert arrivals(points, start, path, end)[1] <= most + 1e-9
        later = sum(map(len, paths[robots:]))
        assert later == 0 if present is enough else later > 0


def test_flights_that_are_planned_together_need_fewer_metres():
    """Against flights that each collect as much as possible."""
    metres = np.zeros(2)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        points, home = lattice(10, 10), np.array([[rng.uniform(0.0, 9.0), 0.0]])
        for kind, number in enumerate((1, 5)):
            left, budget = np.arange(100), 26.0
            while len(left):
                homes = np.repeat(home, number, axis=0)
                budgets, worths = np.full(number, budget), 1.0 - 0.5 * np.arange(number) / number
                path, *_ = plan_routes(
                    points[left], np.ones(len(left)), homes, budgets, homes, worths=worths
                )
                metres[kind] += arrivals(points[left], home[0], path, home[0])[1]
                left = np.delete(left, path)
    assert metres[1] < 0.95 * metres[0]
