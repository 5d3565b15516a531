"""Median times of whole decisions, with predicted trajectories, and of paths around obstacles."""

from dataclasses import replace
from functools import cache, partial
from time import perf_counter

import numpy as np
from scipy.sparse import block_array, csr_array
from scipy.sparse.csgraph import dijkstra
from timing import against, entry, few, median_time

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.detection import BoxDetection, ExponentialDetection
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import (
    CandidateSet,
    CandidateSettings,
    MotionSettings,
    RobotState,
    RobotView,
    TeamView,
    make_motion,
    make_planner,
    planner_settings,
    warm_up,
)
from maasi_planner.endurance import Endurance, EnduranceSettings
from maasi_planner.guidance import length_to
from maasi_planner.keep_out import CORNERS, KeepOut
from maasi_planner.planners.options import options_of
from maasi_planner.planners.orienteering import plan_routes
from maasi_planner.visibility import VisibilityGraph, _last_legs

CUBE = np.array([[0.0, 260.0]] * 3)
FLOOR = np.array([[-0.3, 2.4]] * 2)
PAPER = planner_settings(objective='paper', alpha=0.5, beta=0.5, control_weight=0.01)


def robot(place, bounds, grid, motion, size, noise, period=10, radius=0.1):
    """Return a robot that plans now, with a grid of candidates (numbers, spacing, corner)."""
    numbers, spacing, corner = grid
    settings = CandidateSettings(grid=numbers, spacing=spacing, corner=corner)
    detection = ExponentialDetection(0.98, size)
    return RobotView(
        state=RobotState.at_rest(place),
        candidates=CandidateSet(settings, bounds, place[2]).at(np.array(place)),
        motion=make_motion(MotionSettings(**motion)),
        sensor=Sensor('robot', detection, np.diag(noise) ** 2),
        period_steps=period,
        radius=radius,
    )


def team_of(robots, step, bounds, spacing, rng, deviation):
    """Return a team with six clusters in a half explored environment."""
    dimension, side = len(bounds), bounds[0, 1] if len(bounds) == 3 else 2.0
    covariance = deviation**2 * np.eye(dimension)
    centres = [rng.uniform(0.0, side, dimension) for _ in range(6)]
    clusters = [Cluster(centre, covariance, deviation, 0.8) for centre in centres]
    exploration = UnexploredMap(bounds, spacing)
    exploration.values[...] = np.random.default_rng(0).uniform(size=exploration.values.shape)
    return TeamView(0, step, robots, clusters, exploration)


def drones(number, model='constant_speed'):
    """Return ranging drones in the papers' cube, 27 candidates each."""
    rng = np.random.default_rng(1)
    # 12 m/s, a measurement each second, as in 000, section 5.1; the Mambo at 4 m/s every 3 s.
    speed, period = (12.0, 10) if model == 'constant_speed' else (4.0, 30)
    motion = {'model': model, 'speed': speed, 'tolerance': 1.0}
    grid = [3, 3, 3], 120.0, [10.0] * 3
    places = [[120.0, 125.0, 118.0], *(rng.uniform(0.0, 260.0, 3) for _ in range(number - 1))]
    robots = {
        f'drone{n}': robot(place, CUBE, grid, motion, [25.0] * 3, [1.5, 0.175, 0.295], period, 1.0)
        for n, place in enumerate(places)
    }
    return team_of(robots, 0.1, CUBE, 10.0, rng, 5.0)


def floor_pair():
    """Return Mambo and TurtleBot on the floor of 000, section 7.1.3: 9 and 64 candidates."""
    mambo = {'model': 'mambo', 'speed': 0.4}
    turtlebot = {'model': 'unicycle', 'speed': 0.2, 'yaw_rate': 2.84, 'acceleration': 2.5}
    grids = ([3, 3], 0.6, [0.1, 0.1]), ([8, 8], 0.25, [0.0, 0.0])
    robots = {
        'mambo': robot([1.9, 1.9, 1.0], FLOOR, grids[0], mambo, [0.3] * 2, [0.016, 0.052]),
        'turtlebot': robot(
            [0.1, 0.1, 0.0], FLOOR, grids[1], turtlebot, [0.15] * 2, [0.011, 0.0311]
        ),
    }
    return team_of(robots, 0.05, FLOOR, 0.1, np.random.default_rng(2), 0.1)


def field(batteries):
    """Return three drones at the edge of an area of 2,025 squares of a swath of 20 m."""
    bounds, grid = np.array([[0.0, 900.0]] * 2), ([3, 3], 300.0, [150.0] * 2)
    motion = {'speed': 5.0, 'acceleration': 5.0}
    robots = {
        f'drone{n}': replace(
            robot([300.0 * n + 150.0, 1.0, 30.0], bounds, grid, motion, [25.0] * 2, [1.0] * 2),
            sensor=Sensor('robot', BoxDetection([-10.0] * 2, [10.0] * 2, 0.98), np.eye(2)),
        )
        for n in range(3)
    }
    if batteries:
        # For 9 km and the reserve: two thirds of the area in all.
        settings = EnduranceSettings(per_metre=0.75 / 9000.0)
        for name, view in robots.items():
            endurance = Endurance(settings, view.motion, view.state.pose.position)
            endurance.update_charge(1.0)
            robots[name] = replace(view, endurance=endurance)
    return TeamView(0, 0.1, robots, [], UnexploredMap(bounds, 5.0))


def among_obstacles():
    """Return the keep-out regions of a robot among 16 discs in a square of 400 m."""
    rng = np.random.default_rng(3)
    places = 100.0 * (np.indices((4, 4)).reshape(2, 16).T + rng.uniform(0.3, 0.7, (16, 2)))
    zones = [{'centre': place, 'radius': rng.uniform(10.0, 25.0)} for place in places.tolist()]
    return KeepOut(Area(EnvironmentSettings(bounds=[[0.0, 400.0]] * 2, keep_outs=zones)), 0.5, 1.0)


def pyvisgraph_times(keep_out, start, goal):
    """Return the times in which pyvisgraph builds the same graph, and finds a path [ms]."""
    import pyvisgraph

    rings = keep_out.around.vertices.reshape(-1, CORNERS, 2).tolist()
    polygons = [[pyvisgraph.Point(*corner) for corner in ring] for ring in rings]
    graph, ends = pyvisgraph.VisGraph(), [pyvisgraph.Point(*end[:2]) for end in (start, goal)]
    build = median_time(partial(graph.build, polygons, status=False), 1)
    find = partial(graph.shortest_path, *ends)
    path = np.array([(point.x, point.y) for point in find()])
    theirs = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    ours = keep_out.path_length(start, goal)
    if abs(theirs - ours) > 0.01 * ours:
        raise RuntimeError(f'pyvisgraph: another shortest path, {theirs} m and not {ours} m')
    return 1e3 * build, 1e3 * median_time(find, 3)


def dijkstra_time(graph, goal, repeats):
    """Return the time in which SciPy finds the lengths to a goal on the same graph [s]."""
    first, ends, lengths = graph._edges
    last = _last_legs(goal, graph.around)
    seen, number = np.flatnonzero(last < np.inf), len(last)
    to_goal = csr_array((last[seen], (seen, np.zeros_like(seen))), (number, 1))
    edges = csr_array((lengths, ends, first), (number, number))
    edges = block_array([[edges, to_goal], [to_goal.T, None]], format='csr')
    find = partial(dijkstra, edges, indices=number)
    if not np.allclose(find()[:number], graph.to_goal(goal)):
        raise RuntimeError('SciPy: other shortest lengths')
    return median_time(find, repeats)


def paths_around_obstacles(share):
    """Yield times of a visibility graph of 192 corners, of its lengths to a goal, and of a path."""
    keep_out, start, goal = among_obstacles(), (5.0, 5.0, 0.0), (395.0, 390.0, 0.0)
    graph, repeats = VisibilityGraph(keep_out.around, 0.4), few(share, 200)
    length = partial(length_to, start, goal, graph.to_goal(goal), keep_out.around)
    build, to_goal, path = (
        1e3 * median_time(call, repeats)
        for call in (
            partial(VisibilityGraph, keep_out.around, 0.4),
            partial(graph.to_goal, goal),
            lambda: (graph.to_goal(goal), length()),
        )
    )
    theirs = cache(partial(pyvisgraph_times, keep_out, start, goal))
    yield against('visibility_graph', build, 'pyvisgraph', lambda: theirs()[0])
    yield against('shortest_path', path, 'pyvisgraph', lambda: theirs()[1])
    scipy = 1e3 * dijkstra_time(graph, goal, repeats)
    what = f'SciPy, dijkstra, {scipy:.3g} ms, without visibility of the goal'
    yield entry('shortest_lengths', to_goal, 'ms', what, scipy / to_goal)


def pyvrp_prize(points, prizes, starts, budgets, seconds):
    """Return the prize that PyVRP collects within budgets, each robot back at its start."""
    from pyvrp import Model
    from pyvrp.stop import MaxRuntime

    # PyVRP takes whole numbers: of four pairs of scales the one with which it collects most.
    scale, worth, model = 100.0, 1e5 / prizes.sum(), Model()
    nodes = np.vstack([starts, points])
    places = [model.add_location(*(scale * node).round().astype(int).tolist()) for node in nodes]
    for place, budget in zip(places, budgets):
        depot = model.add_depot(place)
        model.add_vehicle_type(start_depot=depot, end_depot=depot, max_distance=int(scale * budget))
    for place, prize in zip(places[len(starts) :], prizes):
        model.add_client(place, prize=round(worth * prize), required=False)
    gaps = np.ceil(scale * np.linalg.norm(nodes[:, None] - nodes, axis=2)).astype(int).tolist()
    for row, here in enumerate(places):
        for column, there in enumerate(places):
            if row != column:
                model.add_edge(here, there, gaps[row][column])
    best = model.solve(MaxRuntime(seconds), display=False, collect_stats=False).best
    if not best.is_feasible():
        raise RuntimeError('PyVRP: beyond a budget')
    return best.prizes() / worth


def prizes_within_budgets(share):
    """Yield the prize on lattices with hot spots [%], next to PyVRP in equal time."""
    for side, robots in ((17, 1), (25, 3), (35, 10)):
        rng = np.random.default_rng(side)
        points = np.stack(np.meshgrid(*2 * [np.arange(side) + 0.5]), axis=-1).reshape(-1, 2)
        gaps = np.linalg.norm(points[:, None] - rng.uniform(0.0, side, (3, 2)), axis=2)
        prizes = 0.1 + np.exp(-((gaps / (0.1 * side)) ** 2)).sum(axis=1)
        starts = np.column_stack([rng.uniform(0.0, side, robots), np.zeros(robots)])
        budgets = np.full(robots, 0.4 * side**2 / robots)
        plan = partial(plan_routes, points, prizes, starts, budgets, starts)
        plan(effort=0.01)
        begun = perf_counter()
        visited = np.concatenate(plan(effort=4.0 * share))
        seconds = perf_counter() - begun
        ours = 100.0 * float(prizes[visited].sum() / prizes.sum())
        name = f'prize_{side}x{side}_of_{robots}'
        try:
            prize = pyvrp_prize(points, prizes, starts, budgets, seconds)
        except ImportError as error:
            yield entry(name, ours, '%', f'PyVRP: not measured, {error}')
            continue
        theirs = 100.0 * float(prize / prizes.sum())
        what = f'PyVRP, {theirs:.3g} % in the same {seconds:.2g} s'
        yield entry(name, ours, '%', what, ours / theirs)


def whole_grid_decision(team):
    """Return the best value of one robot by (17) to (22) as they are written."""
    from plain_objective import plain_terms

    (name,) = team.planning()
    options = {name: options_of(team, name, [])}
    choices = range(len(options[name].points))
    return max(plain_terms(team, PAPER, options, {name: w})[name][2] for w in choices)


def run(share=1.0):
    warm_up()
    single, pair, floor = drones(1), drones(2), floor_pair()
    whole = median_time(lambda: whole_grid_decision(single), 3)
    information = planner_settings()
    for name, team, repeats, settings in (
        ('asi_decision', single, 200, PAPER),
        ('asi_decision_mambo', drones(1, 'mambo'), 50, PAPER),
        ('maasi_decision_pair', pair, 60, PAPER),
        ('maasi_decision_mambo_turtlebot', floor, 60, PAPER),
        ('maasi_decision_ten', drones(10), 20, PAPER),
        ('asi_decision_information', single, 50, information),
        ('maasi_decision_pair_information', pair, 30, information),
        ('maasi_decision_mambo_turtlebot_information', floor, 30, information),
    ):
        planner = make_planner('maasi', settings)
        value = median_time(lambda: planner.decide(team), few(share, repeats))  # noqa: B023
        compared = (
            ('e on the whole grid, h = 10 m', whole / value) if name == 'asi_decision' else ()
        )
        yield entry(name, 1e3 * value, 'ms', *compared)
    yield from paths_around_obstacles(share)
    yield from prizes_within_budgets(share)
    for batteries in (False, True):
        team, planners = field(batteries), [make_planner('tour') for _ in range(few(share, 5) + 1)]
        first = median_time(lambda: planners.pop().decide(team), len(planners) - 1)  # noqa: B023
        name = 'tour_decision_2025_squares' + '_batteries' * batteries
        yield entry(name, 1e3 * first, 'ms')
        planner = make_planner('tour')
        planner.decide(team)
        later = median_time(lambda: planner.decide(team), few(share, 20))  # noqa: B023
        yield entry(f'{name}_at_arrival', 1e3 * later, 'ms', 'the first decision', first / later)
