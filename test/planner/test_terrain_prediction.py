"""Planners expect what the simulation and the filter see over random terrain, and no more."""

from dataclasses import replace

import numpy as np
import pytest
from planner_helpers import planning_robot
from test_tour import fly

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.detection import BoxDetection, ExponentialDetection
from maasi_filter.models.line_of_sight import probability_in_sight
from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import RobotState, TeamView, make_planner
from maasi_planner.measurement_schedule import expected_use
from maasi_planner.objective import information_terms, sight
from maasi_planner.objective.predicted_measurements import chances, planned_paths, predicted
from maasi_planner.objective.settings import InformationSettings
from maasi_planner.objective.sight import SightTables, is_hidden
from maasi_planner.objective.team_objective import TeamObjective
from maasi_planner.planners.lattice import Lattice, lanes_of
from maasi_planner.planners.mutual_information import heading_to, mutual_information
from maasi_planner.team import UsableCandidates

SIZE = 12.0
BOX = BoxDetection([-3.0, -2.5], [2.0, 2.5], 0.8, 'robot')
WIDE = ExponentialDetection(0.9, [1.5, 1.5])


def rough(seed, scale=1.0):
    """Return random hills over the area and around it."""
    generator = np.random.default_rng(seed)
    x, y = np.meshgrid(*[np.arange(-2.0, SIZE + 2.5, 0.5)] * 2, indexing='ij')
    heights = 0.15 * generator.standard_normal(x.shape)
    for _ in range(5):
        east, north = generator.uniform(0.0, SIZE, 2)
        wide = generator.uniform(0.4, 1.5)
        distance = (x - east) ** 2 + (y - north) ** 2
        heights += generator.uniform(0.5, 3.0) * np.exp(-0.5 * distance / wide**2)
    return Terrain(scale * heights, [-2.0, -2.0], [0.5, 0.5])


def team_over(terrain, detection=BOX, height=0.7, spacing=0.5, seed=0):
    generator = np.random.default_rng(seed)
    area = Area(np.array([[0.0, SIZE]] * 2))
    area.terrain = terrain
    candidates = np.full((6, 3), height)
    candidates[:, :2] = generator.uniform(0.5, SIZE - 0.5, (6, 2))
    start = [*generator.uniform(1.0, SIZE - 1.0, 2), height]
    view = planning_robot(start, detection, candidates=candidates)
    view.period_steps = 7
    exploration = UnexploredMap(area, spacing)
    exploration.values[...] = generator.uniform(size=exploration.values.shape)
    return TeamView(0, 0.1, {'robot0': view}, [], exploration)


def objective_of(team, **settings):
    view = team.robots['robot0']
    paths = view.motion.predict(view.state, view.candidates, team.step_time)
    options = {'robot0': UsableCandidates(view.candidates, paths, paths.lengths > 0)}
    table = SightTables().of(team.exploration, team.robots.values())
    return TeamObjective(team, InformationSettings(**settings), options, table), paths


@pytest.mark.parametrize('seed', range(4))
def test_the_table_has_lines_of_sight_between_rounded_positions(seed, monkeypatch):
    terrain, generator = rough(seed), np.random.default_rng(seed)
    for most in (sight.MOST_BYTES, 300_000, 0):
        monkeypatch.setattr(sight, 'MOST_BYTES', most)
        team = team_over(terrain, height=0.9)
        table = SightTables().of(team.exploration, team.robots.values())
        assert table.values.size <= most
        apart = 0.0 if most == 0 else table.apart[0]
        assert apart == {300_000: 0.5, 0: 0.0}.get(most, 0.25)
        seen = 0
        for _ in range(300):
            start = generator.uniform(0.0, SIZE, 2)
            step = team.exploration.step
            node = np.clip(np.round((start + generator.uniform(-2, 2, 2)) / step), 0, 24) * step
            if apart:
                start = np.floor(start / apart + 0.5) * apart
            above = [*start, terrain.height(start) + 0.9]
            expected = not terrain.visible(above, terrain.on_ground(node[None]))[0]
            # Twice: computed, then read.
            for _ in range(2):
                assert is_hidden(table, 0, *start, *node) == expected
            seen += not expected
        assert 30 < seen < 290


@pytest.mark.parametrize('detection', [BOX, WIDE])
@pytest.mark.parametrize('seed', range(4))
def test_expected_new_targets_are_those_that_the_map_would_lose(detection, seed, monkeypatch):
    monkeypatch.setattr(sight, 'MOST_BYTES', 0)
    terrain = rough(seed)
    team = team_over(terrain, detection, seed=seed)
    objective, paths = objective_of(team, exploration_nodes=10_000)
    height = team.robots['robot0'].height
    whole = team.exploration.cell_volumes().sum()
    flat = objective_of(team_over(None, detection, seed=seed), exploration_nodes=10_000)[0]

    def update(unseen, row, k):
        place = paths.positions[row, k].copy()
        place[2] = terrain.height(place) + height
        unseen.update(detection, Pose.from_yaw(place, paths.yaws[row, k]))

    for row, length in enumerate(paths.lengths):
        # The present measurement does not depend on the choice.
        before = team.exploration.copy()
        update(before, row, 0)
        after = before.copy()
        for k in [*range(7, length, 7), length]:
            update(after, row, k)
        lost = (before.values - after.values) * team.exploration.cell_volumes()
        expected = team.area.expected_targets * lost.sum() / whole
        # Detections with less than a fiftieth of the best probability are neglected over terrain.
        least = 0.0 if detection is BOX else 0.1
        assert objective.alone[row, 1] == pytest.approx(expected, rel=least + 1e-9)
    assert objective.alone[:, 1].sum() < 0.95 * flat.alone[:, 1].sum()


def test_level_terrain_changes_no_decision():
    for seed in range(3):
        values = []
        for terrain in (None, rough(seed, scale=0.0)):
            team = team_over(terrain, seed=seed)
            team.clusters = [Cluster(np.array([4.2, 6.3]), 0.01 * np.eye(2), 0.1, 0.9)]
            built, _ = objective_of(team)
            values.append(built.alone)
        np.testing.assert_array_equal(*values)


def chance_at(team, row_pose, points):
    """Return pi at points (n, 2) from a pose with its height above the ground."""
    place = row_pose.position.copy()
    place[2] += team.area.terrain.height(place)
    view = team.robots['robot0']
    pose = Pose(place, row_pose.orientation)
    return probability_in_sight(view.sensor.detection, points, pose, team.area.terrain)


@pytest.mark.parametrize('detection', [BOX, WIDE])
@pytest.mark.parametrize('seed', range(3))
def test_terms_of_the_papers_count_only_what_is_in_sight(detection, seed, monkeypatch):
    """T (19) is a sum of pi at the centres; E (22) leaves what other robots see in sight."""
    monkeypatch.setattr(sight, 'MOST_BYTES', 0)
    generator = np.random.default_rng(seed)
    team = team_over(rough(seed), detection, seed=seed)
    centres = generator.uniform(1.0, SIZE - 1.0, (8, 2))
    team.clusters = [Cluster(centre, 0.01 * np.eye(2), 0.1, 0.9) for centre in centres]
    alone, paths = objective_of(team, objective='paper')
    view = team.robots['robot0']
    parked = replace(view, planning=False, state=RobotState.at_rest([6.0, 6.0, 0.7]))
    team.robots['robot1'] = parked
    objective, _ = objective_of(team, objective='paper')
    from_there = Pose.from_yaw(np.array([6.0, 6.0, 0.7]), 0.0)
    nodes = team.exploration.nodes()
    hidden = detection.probability(nodes, from_there) > chance_at(team, from_there, nodes)
    assert hidden.sum() > 10
    for row, length in enumerate(paths.lengths):
        poses = [
            Pose.from_yaw(paths.positions[row, k], paths.yaws[row, k])
            for k in [*range(7, length, 7), length]
        ]
        expected = sum(chance_at(team, pose, centres).sum() for pose in poses)
        assert objective.alone[row, 0] == pytest.approx(expected, abs=1e-9)
        assert objective.alone[row, 1] <= alone.alone[row, 1] + 1e-12
    # One robot that has a node in sight and another node hidden leaves the hidden one as it was.
    unseen = team.exploration.values.copy()
    team.exploration.values[...] = np.where(hidden.reshape(unseen.shape), unseen, 0.0)
    whole = objective_of(replace(team, robots={'robot0': view}), objective='paper')[0]
    rest = objective_of(team, objective='paper')[0]
    np.testing.assert_allclose(rest.alone[:, 1], whole.alone[:, 1], rtol=0.02)


@pytest.mark.parametrize('seed', range(3))
def test_planners_of_waypoints_expect_only_what_is_in_sight(seed):
    team, generator = team_over(rough(seed), seed=seed), np.random.default_rng(seed)
    centres = generator.uniform(1.0, SIZE - 1.0, (40, 2))
    team.clusters = [Cluster(centre, 1e-6 * np.eye(2), 0.1, 0.9) for centre in centres]
    view = team.robots['robot0']
    poses = [
        Pose.from_yaw(point, heading_to(view, view.state.pose.position, point))
        for point in view.candidates
    ]
    found = np.array([chance_at(team, pose, centres) for pose in poses])
    flat = np.array([BOX.probability(centres, pose) for pose in poses])
    assert (found < flat).any()
    decision = make_planner('maas').decide(team).robots['robot0']
    np.testing.assert_allclose(decision.target_refinement, found.sum(axis=1), atol=1e-12)
    decision = make_planner('mutual_information').decide(team).robots['robot0']
    weights = np.full(len(centres), 0.9)
    expected = [mutual_information(1.0 - row, weights) for row in found]
    np.testing.assert_allclose(decision.target_refinement, expected, rtol=1e-6, atol=1e-9)
    for pose, row in zip(poses, found):
        use = expected_use(view.sensor, pose, team.clusters, team.exploration, 0.0)
        assert use == pytest.approx(row.sum())


@pytest.mark.parametrize('seed', range(3))
def test_potential_targets_behind_hills_are_not_expected_in_sight(seed):
    terrain = rough(seed)
    team = team_over(terrain, seed=seed)
    view = team.robots['robot0']
    paths = view.motion.predict(view.state, view.candidates, team.step_time)
    table = SightTables().of(team.exploration, [view])
    measured = predicted([planned_paths(view, paths, True)], 0, False, table)
    points = np.zeros((40, 3))
    points[:, :2] = np.random.default_rng(seed).uniform(0.0, SIZE, (40, 2))
    found = chances(measured, 0, points)
    for g in range(len(measured.own)):
        for e in range(measured.own[g]):
            place = measured.positions[g, e].copy()
            place[2] = terrain.height(place) + view.height
            pose = Pose.from_yaw(place, measured.yaws[g, e])
            expected = probability_in_sight(BOX, points[:, :2], pose, terrain)
            np.testing.assert_allclose(found[g, e], expected, atol=1e-12)


def test_blocks_of_nodes_stand_for_what_is_left_of_them():
    team = team_over(rough(1), WIDE, spacing=0.25)
    nodes = information_terms._nodes(team, InformationSettings(exploration_nodes=150), False)
    left = (team.exploration.values * team.exploration.cell_volumes()).ravel()
    where = {tuple(node): value for node, value in zip(team.exploration.nodes(), left)}
    stride = round(float(nodes.step[0] / team.exploration.step[0]))
    share = left.sum() / team.exploration.cell_volumes().sum()
    assert stride > 1
    assert nodes.unseen.sum() == pytest.approx(team.area.expected_targets * share)
    values = left.reshape(team.exploration.values.shape)
    shape = nodes.numbers.shape
    for number, place in enumerate(nodes.positions[:2].T):
        i, j = divmod(number, shape[1])
        block = values[i * stride : (i + 1) * stride, j * stride : (j + 1) * stride]
        assert where[tuple(place)] == block.max()


@pytest.mark.parametrize('seed', range(4))
def test_a_cell_of_a_tour_shows_what_is_in_sight_from_its_middle(seed):
    terrain, height = rough(seed), 0.7
    box = BoxDetection([-1.0, -1.0], [1.0, 1.0], 0.9, 'world')
    team, level = (team_over(ground, box, height) for ground in (terrain, rough(seed, scale=0.0)))
    lattice, plain = (Lattice(one.exploration, *lanes_of(one)[1:], height) for one in (team, level))
    every = np.arange(lattice.trust.size)
    exploration, nodes = level.exploration, team.exploration.nodes()
    hidden = 0
    for cell in every:
        # With unseen targets at one node only, in a cell that is unseen as a whole.
        exploration.values[...] = team.exploration.values[...] = 1.0
        (place,) = lattice.points(exploration, np.array([cell]))
        above = [*place, terrain.height(place) + height]
        gains = [one.gains(exploration, np.array([cell]))[0] for one in (lattice, plain)]
        visible = terrain.visible(above, terrain.on_ground(nodes)).reshape(exploration.values.shape)
        exploration.values[~visible] = 1e-3
        assert gains[0] <= gains[1] + 1e-12
        # All that it shows is visible.
        seen = plain.gains(exploration, np.array([cell]))[0]
        assert seen >= gains[0] - 1e-12
        assert seen - gains[0] <= 1e-3 * gains[1] + 1e-12
        hidden += gains[0] < 0.99 * gains[1]
        # Behind the hill, the cell is passed above what is left.
        exploration.values[visible] = 0.0
        exploration.values[~visible] = 1.0
        left = [one.gains(exploration, np.array([cell]))[0] for one in (lattice, plain)]
        inside = np.abs(nodes - place).max(axis=1) < 0.4 * lattice.pitch
        if (~visible.ravel() & inside).any():
            assert left[0] > 0.0
    assert 0 < hidden < len(every)


@pytest.mark.parametrize('seed', range(3))
def test_a_tour_over_rough_ground_ends(seed):
    terrain, height = rough(seed), 0.7
    team = team_over(terrain, BoxDetection([-1.0, -1.0], [1.0, 1.0], 0.9, 'world'), height)
    team.exploration.values[...] = 1.0
    planner, view = make_planner('tour'), team.robots['robot0']
    update = team.exploration.update

    def above(detection, pose):
        update(detection, Pose.from_yaw(team.area.above_ground(pose.position), pose.yaw))

    team.exploration.update = above
    legs = 0
    while planner.finished(team) is None:
        assert fly(planner, team) is not None or view.planning
        legs += 1
        assert legs < 300
    assert team.exploration.explored_fraction() > 0.99
