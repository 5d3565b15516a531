"""Where a robot may be: goals, faults, the geofence and an autopilot's fence agree."""

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from numpy.testing import assert_array_equal

from maasi_drivers.agent.flight_rules import flight_volume, free_length
from maasi_drivers.links.mavlink.fence import fence_items
from maasi_drivers.settings.vehicles import FlightSettings
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.operating_volume import MARGIN
from maasi_planner.motion import make_motion
from maasi_planner.settings import MotionSettings
from maasi_sim.simulation.emulators.mavlink.fake_fence import FakeFence

CLOSE = 0.03  # corners of the autopilot's fence are rounded to 1e-7 degrees [m]


def random_volume(rng):
    """Return a volume over a box or a star, in 2D or 3D, with keep-outs, maybe with a geofence."""
    size = rng.uniform(10.0, 60.0)
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, 9)) + np.linspace(0.0, 1e-3, 9)
    star = rng.uniform(0.3, 1.0, (9, 1)) * size * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    heights = [[0.0, rng.uniform(3.0, 20.0)]] if rng.integers(2) else []
    place = {'bounds': [[-size, size]] * 2 + heights}
    if rng.integers(2) and shapely.Polygon(star).is_valid:
        place = {'area': star.tolist()} | ({'altitude': heights[0]} if heights else {})
    zones = [{'centre': rng.uniform(-size, size, 2).tolist(), 'radius': rng.uniform(0.5, 4.0)}]
    corner = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]])
    zones.append((rng.uniform(-size, size, 2) + corner).tolist())
    origin = {'latitude': rng.uniform(-60.0, 60.0), 'longitude': rng.uniform(-180.0, 180.0)}
    place |= {'origin': origin, 'keep_outs': zones}
    fence = [[-0.5 * size, 0.6 * size]] * 2 + [[0.5, 3.0]] if rng.integers(2) else None
    settings = FlightSettings(geofence=fence, ground=rng.uniform(-1.0, 1.0))
    area = Area(EnvironmentSettings.model_validate(place))
    robot = SimpleNamespace(radius=rng.uniform(0.05, 0.6), start=[0.0, 0.0, rng.uniform(-2.0, 3.0)])
    return flight_volume(area, robot, settings)


@pytest.mark.parametrize('seed', range(40))
def test_all_that_ask_where_a_robot_may_be_agree(seed):
    rng = np.random.default_rng(seed)
    volume = random_volume(rng)
    area, dimension = volume.area, volume.area.dimension
    fence = FakeFence(None, {'FENCE_ENABLE': 1, 'FENCE_TYPE': 4})
    fence.home, fence.items = area.settings.origin, fence_items(volume, [0.0, 0.0, 0.0])
    edges = shapely.union_all(
        [area.border.boundary, *map(shapely.boundary, area.shapes['keep_out'])]
    )
    low, high = np.pad(area.bounds, ((0, 3 - dimension), (0, 0)), constant_values=1.0).T
    reach = 3.0 * MARGIN + volume.radius
    for position in rng.uniform(low - reach, high + reach, (300, 3)):
        accepted = not volume.goal_problem(position.tolist())
        outside, overhang = volume.beyond_border(position)
        gap, nearest = volume.distance_outside(position), volume.nearest_inside(position)
        drift, breached = volume.drift_problem(position), fence.breach(position, 0.0)
        close = edges.distance(shapely.Point(position[:2])) < CLOSE
        # What a planner may choose between the limits the driver accepts.
        if gap == 0.0 and area.inside([position[:dimension]])[0]:
            assert accepted
        # What the driver accepts is no fault of it, and inside of what the autopilot has.
        if accepted:
            assert outside <= np.hypot(overhang, overhang) + 1e-6 and gap == 0.0 and not drift
            assert_array_equal(nearest, position)
            assert close or not breached
        # Where the driver begins its fault the autopilot acts.
        if outside > overhang + MARGIN + CLOSE and area.settings.area is not None:
            assert breached
        assert not drift or gap > MARGIN
        assert gap <= MARGIN or drift or position[2] < volume.limits[2, 0]
        assert volume.distance_outside(nearest) == 0.0
        assert np.abs(nearest - position).max() == gap


@pytest.mark.parametrize('seed', range(20))
def test_the_free_length_of_a_path_ends_before_a_zone(seed):
    rng = np.random.default_rng(seed)
    area = random_volume(rng).area
    motion = make_motion(MotionSettings(model='constant_speed', speed=1.0), area, 0.3)
    low, high = np.pad(area.bounds, ((0, 3 - area.dimension), (0, 0)), constant_values=1.0).T
    for longest in (0.0, 1e-9, *rng.uniform(0.0, 5.0, 20)):
        position = rng.uniform(low, high)
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        free = free_length(motion, position, direction, longest)
        assert 0.0 <= free <= longest + 1e-9
        if free > 0.0:
            assert motion.keep_out.is_free(position + free * direction)
