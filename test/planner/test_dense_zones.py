"""Many zones and walls: the same paths as among few, in little time, out of each zone."""

import numpy as np
import pytest
import shapely

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.keep_outs import CORNERS, ZONES, with_keep_outs
from maasi_planner import MotionSettings, RobotState, make_motion
from maasi_planner.guidance import MANY
from maasi_planner.keep_out import KeepOut
from maasi_planner.obstacles import clearance_at, is_free_at, is_visible

DRONE = {'speed': 5.0, 'acceleration': 3.0, 'clearance': 1.0, 'tolerance': 0.5}
ROVER = {
    'model': 'unicycle',
    'speed': 1.0,
    'acceleration': 1.0,
    'yaw_rate': 1.5,
    'clearance': 0.5,
    'tolerance': 0.3,
}
WINDOW = {**ROVER, 'yaw_acceleration': 4.0, 'avoidance': 'dynamic_window'}


def area_of(**values):
    return Area(EnvironmentSettings.model_validate(values))


def zones_of(rng, number):
    """Return discs and polygons, some of which overlap, in a square of 200 m."""
    zones = []
    for n in range(number):
        x, y, size = *rng.uniform(10.0, 190.0, 2).tolist(), float(rng.uniform(1.0, 5.0))
        if n % 2:
            zones.append({'centre': [x, y], 'radius': size})
        else:
            angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, 7))
            ring = np.stack([x + size * np.cos(angles), y + size * np.sin(angles)], 1)
            zones.append(ring.tolist())
    return zones


def pairs_of(rng, number):
    """Return ends of lines, long and short ones, also outside of the area."""
    starts = rng.uniform(-20.0, 220.0, (number, 2))
    ends = starts + rng.normal(0.0, 1.0, (number, 2)) * rng.choice([1.0, 10.0, 80.0], (number, 1))
    return [((*a, 5.0), (*b, 5.0)) for a, b in zip(starts.tolist(), ends.tolist())]


def test_a_grid_over_the_obstacles_changes_no_answer():
    """What is near, visible and free is the same with every obstacle looked at."""
    rng = np.random.default_rng(4)
    seen = 0
    for number in (40, 150):
        area = area_of(bounds=[[0.0, 200.0]] * 2, keep_outs=zones_of(rng, number))
        all_of, listed = KeepOut(area, 0.5, 1.0), KeepOut(area, 0.5, 1.0, 15.0)
        assert all_of.around.nearby.cells.size == 2 < listed.around.nearby.cells.size
        gaps = all_of.circles
        for start, end in pairs_of(rng, 400):
            extra = float(rng.choice([0.0, 0.4]))
            visible = is_visible(start, end, all_of.around, extra, True)
            assert is_visible(start, end, listed.around, extra, True) == visible, (start, end)
            assert is_free_at(start, all_of.around) == is_free_at(start, listed.around)
            seen += visible
            offsets = np.array(start[:2]) - gaps[:, :2]
            along = gaps[:, 5:]
            square = np.maximum((along * along).sum(axis=1), 1e-12)
            part = np.clip((offsets * along).sum(axis=1) / square, 0.0, 1.0)
            true = np.linalg.norm(offsets - part[:, None] * along, axis=1) - gaps[:, 3]
            assert clearance_at(start, listed.around) <= true.min() + 1e-9
    assert 200 < seen < 700


def test_paths_among_many_zones_are_little_longer_than_the_shortest():
    """Against the visibility graph of all corners, made by shapely."""
    rng = np.random.default_rng(8)
    area = area_of(bounds=[[0.0, 200.0]] * 2, keep_outs=zones_of(rng, 30))
    keep_out = KeepOut(area, 0.5, 1.0, 15.0)
    assert len(keep_out.around.vertices) > MANY
    zones = shapely.union_all(area.shapes['keep_out'])
    room = area.border.difference(zones.buffer(0.5 + 0.1))
    shapely.prepare(room)
    inner = room.buffer(-1e-6)
    corners = shapely.get_coordinates(zones.buffer(0.5 + 0.11, quad_segs=2).simplify(0.05))
    places = np.array([p for p in rng.uniform(5.0, 195.0, (60, 2)) if keep_out.is_free([*p, 0.0])])
    points = np.vstack([places[:6], corners[shapely.contains_xy(inner, *corners.T)]])
    first, second = np.triu_indices(len(points), 1)
    lines = shapely.linestrings(np.stack([points[first], points[second]], axis=1))
    seen = shapely.covers(room, lines)
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    lengths = shapely.length(lines)[seen]
    ends = first[seen].astype(np.int32), second[seen].astype(np.int32)  # as SciPy 1.11 has to have
    graph = csr_array((lengths, ends), (len(points),) * 2)
    shortest = dijkstra(graph, directed=False, indices=range(6))[:, :6]
    for i in range(6):
        for j in range(i):
            length = keep_out.path_length([*places[i], 0.0], [*places[j], 0.0])
            assert np.isinf(length) == np.isinf(shortest[i, j])
            if np.isfinite(length):
                # Corners are passed at the clearance, which is what makes them longer.
                assert 0.98 * shortest[i, j] <= length <= 1.1 * shortest[i, j] + 2.0


@pytest.mark.parametrize('settings', [DRONE, ROVER, WINDOW])
def test_a_robot_leaves_a_zone_at_full_speed_by_its_exit(settings):
    """Whatever shape is drawn over it, also near the border; it stays in the area."""
    rng, left, slow = np.random.default_rng(11), 0, 0
    for trial in range(24):
        here = np.append(rng.uniform(3.0, 57.0, 2), 0.0)
        size = float(rng.uniform(3.0, 9.0))
        offset = rng.uniform(-0.6, 0.6, 2) * size
        x, y = (here[:2] + offset).tolist()
        zone = {'centre': [x, y], 'radius': size}
        if trial % 2:
            angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, 5)) + np.arange(5)
            ring = [[x + size * np.cos(t), y + size * np.sin(t)] for t in np.sort(angles % 6.28)]
            zone = ring
        area = area_of(
            area=[[0.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0]],
            obstacles=[{'centre': [30.0, 30.0], 'radius': 2.0}],
            keep_outs=[zone],
        )
        point = shapely.Point(here[:2])
        if area.distances(here).min() < 1.5 or area.region.covers(point):
            continue
        motion = make_motion(MotionSettings(**settings), area, 0.5)
        out = motion.keep_out.exit_from(here)
        assert out is not None and motion.keep_out.is_free(out)
        prediction = motion.predict(RobotState.at_rest(here), out[None], 0.1)
        path = prediction.positions[0]
        assert prediction.reached[0]
        places = shapely.points(path[:, :2])
        assert area.border.covers(places).all()
        assert min(area.distances(place).min() for place in path) >= 0.5
        inside = ~shapely.covers(area.region, places)
        # Once it is out it stays out; a rover turns to the exit first.
        assert not inside[np.argmin(inside) :].any()
        way = np.linalg.norm(out - here)
        speed = motion.settings.speed
        turning = 3.0 if 'model' in settings else 0.0
        limit = 1.3 * way / speed + turning + 2.0 * speed / (settings['acceleration'])
        slow += (np.argmin(inside)) * 0.1 > limit
        left += 1
    assert left >= 12 and slow == 0


@pytest.mark.parametrize('settings', [DRONE, ROVER, WINDOW])
def test_an_obstacle_far_away_costs_no_time(settings):
    """Robots of any speed and acceleration cross open ground as fast as without obstacles."""
    rng = np.random.default_rng(8)
    for _ in range(12):
        speed, length = float(rng.uniform(0.3, 6.0)), float(rng.uniform(20.0, 80.0))
        limits = {'speed': speed, 'acceleration': float(rng.uniform(0.2, 3.0))}
        aside = length + 100.0
        zones = [{'centre': [0.5 * length, aside], 'radius': 2.0}]
        bounds = [[-aside, 2.0 * aside], [-aside, 2.0 * aside]]
        steps = []
        for keep_outs in ([], zones):
            area = area_of(bounds=bounds, keep_outs=keep_outs)
            motion = make_motion(MotionSettings(**{**settings, **limits}), area, 0.3)
            start = RobotState.at_rest([0.0, 0.0, 0.0])
            steps.append(motion.predict(start, [[length, 0.0, 0.0]], 0.1).lengths[0])
        assert 0 < steps[1] <= 1.05 * steps[0] + 10


def test_the_exit_of_a_zone_leads_past_others():
    """Random zones drawn over a position, with others around: the line to the exit enters none."""
    rng, found = np.random.default_rng(5), 0
    for _ in range(40):
        here = rng.uniform(20.0, 40.0, 2)
        zones = zones_of(rng, 12)
        for zone in zones[::2]:
            centre, near = np.mean(zone, axis=0), here + rng.uniform(-14.0, 14.0, 2)
            zone[:] = (np.array(zone) + near - centre).tolist()
        zones.append({'centre': (here + 1.0).tolist(), 'radius': 5.0})
        area = area_of(bounds=[[0.0, 60.0]] * 2, keep_outs=zones)
        out = KeepOut(area, 0.5, 1.0).exit_from([*here, 0.0])
        point = shapely.Point(here)
        others = [zone for zone in area.shapes['keep_out'] if zone.distance(point) > 0.5]
        assert out is not None
        line = shapely.LineString([here, out[:2]])
        entered = [zone for zone in others if zone.distance(line) < 0.5 - 1e-3]
        clear = shapely.union_all(area.shapes['keep_out']).distance(shapely.Point(out[:2])) > 1.4
        found += clear and not entered
    assert found >= 30


def test_too_many_zones_are_refused_in_one_line_before_they_are_read():
    environment = EnvironmentSettings.model_validate({'bounds': [[0.0, 100.0]] * 2})
    zones = ['50 50 1'] * ZONES
    assert len(with_keep_outs(environment, zones).circles) == ZONES
    with pytest.raises(ValueError, match='1001 zones'):
        with_keep_outs(environment, [*zones, 'no zone'])
    ring = ', '.join(['1 1'] * (CORNERS + 2))
    with pytest.raises(ValueError, match='10001 corners'):
        with_keep_outs(environment, [f'POLYGON (({ring}))'])


def test_robots_stay_within_bounds_where_a_round_zone_lies_at_the_border():
    """A zone across a side of the bounds leaves no path around it on the outside."""
    area = area_of(bounds=[[0.0, 100.0]] * 2, keep_outs=[{'centre': [50.0, 80.0], 'radius': 15.0}])
    for y in (88.0, 95.0, 99.0):
        motion = make_motion(MotionSettings(**DRONE), area, 0.5)
        path = motion.predict(RobotState.at_rest([5.0, y, 20.0]), [[95.0, y, 20.0]], 0.2)
        assert path.reached[0]
        level = path.positions[0, :, :2]
        assert (level >= -1e-6).all() and (level <= 100.0 + 1e-6).all()
        assert area.region.covers(shapely.points(level)).all()
    assert area.outside_by([121.0, 50.0, 20.0]) == pytest.approx(21.0)


def test_a_rover_at_full_speed_touches_no_wall_where_it_turns():
    """Wherever it is sent while it drives along a corridor, and it arrives."""
    rng, arrived = np.random.default_rng(15), 0
    corridor = [[0.0, 0.0], [60.0, 6.0], [60.0, 12.0], [30.0, 9.0], [0.0, 12.0]]
    area = area_of(area=corridor, obstacles=[{'centre': [25.0, 5.6], 'radius': 0.3}])
    settings = MotionSettings(**{**ROVER, 'speed': 2.4, 'yaw_rate': 1.2, 'yaw_acceleration': 2.0})
    motion = make_motion(settings, area, 0.6)
    for _ in range(90):
        x, yaw = float(rng.uniform(10.0, 45.0)), float(rng.choice([0.1, 0.1 + np.pi]))
        heading = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        at = np.array([x, 0.1 * x + rng.uniform(0.9, 2.5), 0.0])
        goal = np.array([*rng.uniform([2.0, 2.0], [58.0, 11.0]), 0.0])
        # It can stop where it goes.
        ahead = [
            motion.keep_out.is_free(at + reach * heading) for reach in np.linspace(0.0, 3.2, 9)
        ]
        if not (all(ahead) and motion.keep_out.is_free(goal)):
            continue
        start = RobotState(Pose.from_yaw(at, yaw), 2.4 * heading, np.zeros(3))
        prediction = motion.predict(start, goal[None], 0.1)
        gaps = [area.distances(place).min() for place in prediction.positions[0]]
        assert min(gaps) >= 0.6
        arrived += bool(prediction.reached[0])
    assert arrived >= 20
