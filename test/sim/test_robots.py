"""Simulated robots: odometry, battery, obstacles, sensors."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from maasi_drivers.agent.odometry import MapOdometry
from maasi_drivers.settings.camera import CameraSettings
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.pose import Pose
from maasi_filter.settings import SensorSettings
from maasi_planner.endurance import EnduranceSettings
from maasi_planner.motion import RobotState
from maasi_planner.settings import MotionSettings
from maasi_sim.scenario.loading import load_scenario, robot_type, scenario_from_values
from maasi_sim.scenario.schema import BatterySettings, RobotSettings
from maasi_sim.simulation.floor import RenderSettings
from maasi_sim.simulation.odometry import OdometryModel, OdometrySettings
from maasi_sim.simulation.robots import SimulatedRobot, Simulation
from maasi_sim.simulation.sensors import LaserSettings
from maasi_sim.simulation.world import TargetSettings, World

PERFECT = OdometrySettings(position_noise=0.0, heading_noise=0.0, velocity_noise=0.0)
DRONE = Pose.from_yaw([1.0, 1.0, 1.0], 0.3)
GROUND = Pose.from_yaw([0.2, 0.3, 0.0], 0.0)


def world(**environment):
    return World.from_settings(
        EnvironmentSettings.model_validate({'bounds': [[-0.3, 2.4], [-0.3, 2.4]], **environment}),
        TargetSettings(positions=[[1.1, 1.05], [0.3, 0.4]]),
        1,
    )


def robot(model='mambo', start=DRONE, seed=1, name='robot', place=None, **changes):
    camera = CameraSettings(focal_length=[220.0, 220.0]) if model == 'mambo' else None
    values = {
        'type': 'any',
        'driver': 'ranging_driver',
        'start': start.position.tolist(),
        'yaw': start.yaw,
        'candidates': {'ring': 4, 'distance': 1.0},
        'motion': MotionSettings(model=model, speed=0.4),
        'sensor': SensorSettings(),
        'camera': camera,
        'odometry': PERFECT,
    }
    settings = RobotSettings(**(values | changes))
    return SimulatedRobot(name, settings, place or world(), RenderSettings(), seed)


def drive(one, steps, command=(0.3, 0.0, 0.0, 0.2), dt=0.05, first=1):
    one.command(command)
    for step in range(first, first + steps):
        one.step(step, dt)


@pytest.mark.parametrize(('model', 'start'), [('mambo', DRONE), ('unicycle', GROUND)])
def test_perfect_odometry_placed_by_the_initial_pose_is_the_true_pose(model, start):
    one = robot(model, start)
    assert_allclose(one.odometry.pose.position, np.zeros(3), atol=1e-12)
    assert_allclose(one.odometry.pose.yaw, 0.0, atol=1e-12)
    drive(one, 80)
    placed = MapOdometry(start).apply(
        0, one.odometry.pose, one.odometry.covariance, one.odometry.velocity
    )
    assert_allclose(placed.pose.position, one.state.pose.position, atol=1e-9)
    assert_allclose(placed.pose.rotation(), one.state.pose.rotation(), atol=1e-9)
    assert_allclose(placed.velocity, one.state.velocity, atol=1e-9)
    assert np.linalg.norm(one.state.pose.position - start.position) > 0.5


def test_the_covariance_of_odometry_is_honest_about_noise_and_drift():
    settings = OdometrySettings(
        position_noise=0.003, heading_noise=0.004, position_drift=0.02, heading_drift=0.05
    )
    start = Pose.from_yaw([2.0, -1.0, 0.0], 0.8)
    nees = []
    for seed in range(120):
        model = OdometryModel(settings, start, seed, 'robot')
        # At rest it does not drift.
        for step in range(-50, 0):
            reading = model.step(RobotState(start), step % 1000)
        assert np.abs(reading.pose.position).max() < 0.02
        for step in range(1, 60):
            angle = 0.03 * step
            place = start.position + np.array([np.sin(angle), 1 - np.cos(angle), 0.0])
            state = RobotState(Pose.from_yaw(place, 0.8 + angle))
            reading = model.step(state, step)
        true = MapOdometry(start)
        placed = true.apply(0, reading.pose, reading.covariance)
        # Height and attitude do not drift.
        assert abs(placed.pose.position[2]) < 0.02
        assert_allclose(placed.pose.rotation()[2], [0.0, 0.0, 1.0], atol=0.01)
        error = np.append(
            (placed.pose.position - state.pose.position)[:2], placed.pose.yaw - state.pose.yaw
        )
        planar = placed.covariance[np.ix_([0, 1, 5], [0, 1, 5])]
        nees.append(error @ np.linalg.solve(planar, error))
    assert 2.5 < np.mean(nees) < 3.5


def test_warming_up_changes_nothing():
    runs = [robot(odometry=OdometrySettings(), laser=LaserSettings()) for _ in range(2)]
    runs[0].warm_up()
    for one in runs:
        drive(one, 10)
    assert_array_equal(*(one.odometry.pose.position for one in runs))
    assert_array_equal(*(one.image(40, 2.0) for one in runs))


def test_an_obstacle_stops_a_robot_short_of_it():
    place = world(obstacles=[{'centre': [1.0, 0.3], 'radius': 0.2}])
    one = robot('unicycle', GROUND, place=place)
    drive(one, 400, (0.2, 0.0, 0.0, 0.0))
    gap = np.linalg.norm(one.state.pose.position[:2] - [1.0, 0.3]) - 0.2
    assert 0.1 <= gap < 0.13
    assert one.collisions > 0
    assert_allclose(one.state.velocity, np.zeros(3), atol=1e-12)
    # It can leave again.
    drive(one, 100, (-0.2, 0.0, 0.0, 0.0), first=401)
    assert one.state.pose.position[0] < 0.6
    with pytest.raises(ValueError, match='robot: got start'):
        robot('unicycle', Pose.from_yaw([0.9, 0.3, 0.0], 0.0), place=place)


def test_an_empty_battery_stops_a_robot_and_brings_a_drone_down():
    battery = BatterySettings(capacity=20.0, idle_power=2.0, motion_power=10.0)
    still, moving = (robot('unicycle', GROUND, battery=battery) for _ in range(2))
    drive(still, 60, (0.0, 0.0, 0.0, 0.0))
    drive(moving, 60, (0.2, 0.0, 0.0, 0.5))
    assert_allclose(still.battery.charge, 1 - 2 * 3 / 20)
    assert moving.battery.charge < still.battery.charge - 0.1
    drive(moving, 200, (0.2, 0.0, 0.0, 0.5), first=61)
    assert moving.battery.empty
    assert_allclose(moving.state.velocity, np.zeros(3), atol=1e-9)
    drone = robot(battery=BatterySettings(capacity=10.0, idle_power=5.0))
    drive(drone, 400, (0.3, 0.0, 0.0, 0.0))
    assert drone.battery.empty
    where = drone.state.pose.position.copy()
    assert where[2] == 0.0
    drive(drone, 20, (0.3, 0.0, 0.5, 0.0), first=401)
    assert_array_equal(drone.state.pose.position, where)


def test_a_robot_that_follows_is_where_its_leader_is():
    sensor = SensorSettings(detection={'kind': 'box', 'lower': [-9, -9], 'upper': [9, 9]})
    place = world(obstacles=[{'centre': [1.8, 1.0], 'radius': 0.1}])
    one = robot('constant_speed', place=place, sensor=sensor)
    leader = SimpleNamespace(state=RobotState.at_rest([1.0, 1.5, 1.0]))
    one.follow(leader)
    one.command([0.3, 0.0, 0.0, 0.0])
    one.step(1, 0.05)
    assert_allclose(one.state.pose.position, [1.0, 1.5, 1.0])
    # It is led through an obstacle: one collision.
    for step, x in enumerate((1.5, 1.75, 1.8, 1.85, 2.2), start=2):
        leader.state = RobotState.at_rest([x, 1.0, 1.0])
        one.step(step, 0.05)
    assert one.collisions == 1
    leader.state = RobotState.at_rest([2.0, 2.0, 1.0])
    one.stand(8)
    assert_allclose(one.state.pose.position, [2.0, 2.0, 1.0])


def test_a_charger_charges_unless_the_battery_cannot_be():
    """In charging_time by default; without endurance a start is no charger."""
    minute = {'capacity': 1000.0, 'charge': 0.5, 'idle_power': 0.0}
    home = EnduranceSettings()
    for battery, endurance, charge in (
        ({}, home, 0.5 + 60.0 / 1800.0),
        ({'charging_time': 240.0}, home, 0.75),
        ({'charging_power': 10.0}, home, 1.0),
        ({'charging_power': 0.0}, home, 0.5),
        ({}, None, 0.5),
        ({'charging_power': 5.0}, None, 0.8),
    ):
        settings = BatterySettings(**minute | battery)
        assert settings.chargeable == (battery.get('charging_power') != 0.0)
        one = robot('unicycle', GROUND, battery=settings, endurance=endurance)
        drive(one, 60, (0.0, 0.0, 0.0, 0.0), dt=1.0)
        assert_allclose(one.battery.charge, charge, atol=1e-9)
        drive(one, 60, (0.4, 0.0, 0.0, 0.0), first=61)
        before = one.battery.charge
        drive(one, 60, (0.0, 0.0, 0.0, 0.0), first=121)
        assert one.battery.charge <= before
    types = ('mambo', 'mavlink_drone', 'ranging_drone', 'rover', 'turtlebot3_burger', 'bluerov2')
    for name in types:
        battery = robot_type(name).battery
        seconds = battery.capacity / battery.power_at_charger
        assert battery.chargeable and 600.0 <= seconds <= 7200.0


@pytest.mark.parametrize('model', ['constant_speed', 'quadrotor'])
def test_wind_carries_robots_that_fly(model):
    """Speed is that through the air: 8 m/s against 3 m/s of wind is 5 m/s over the ground."""
    sensor = SensorSettings(detection={'kind': 'box', 'lower': [-9, -9], 'upper': [9, 9]})
    motion = MotionSettings(model=model, speed=8.0, acceleration=3.0)
    battery = BatterySettings(capacity=1e6, idle_power=0.0, motion_power=1.0)

    def flown(command, wind=(-3.0, 0.0, 0.0), start=None):
        start = start or Pose.from_yaw([0.0, 0.0, 20.0], 0.0)
        one = robot(model, start, sensor=sensor, motion=motion, battery=battery)
        one.wind[:] = wind
        drive(one, 200, command, dt=0.1)
        before, charge = one.state.pose.position, one.battery.charge
        drive(one, 100, command, dt=0.1, first=201)
        moved = (one.state.pose.position - before) / 10.0
        assert_allclose(one.state.velocity, moved, atol=0.02)
        return moved[:2], 1e6 * (charge - one.battery.charge) / 10.0

    fastest, calm = flown((8.0, 0.0, 0.0, 0.0), np.zeros(3))
    speed = fastest[0]
    assert 7.2 < speed < 8.001 and calm == pytest.approx(speed, abs=0.01)
    for command, moved, air in (
        ((8.0, 0.0, 0.0, 0.0), [speed - 3.0, 0.0], speed),
        ((-8.0, 0.0, 0.0, 0.0), [-8.0, 0.0], 5.0),
        ((4.0, 0.0, 0.0, 0.0), [4.0, 0.0], 7.0),
        ((0.0, 0.0, 0.0, 0.0), [0.0, 0.0], 3.0),
        ((0.0, 2.0, 0.0, 0.0), [0.0, 2.0], np.hypot(2.0, 3.0)),
    ):
        over_ground, power = flown(command)
        assert_allclose(over_ground, moved, atol=0.02)
        # What it uses is by its speed through the air.
        assert power == pytest.approx(air, abs=0.05)
    # Commands are turned by the heading, wind is not.
    turned = Pose.from_yaw([0.0, 0.0, 20.0], 1.2)
    assert_allclose(flown((0.0, 0.0, 0.0, 0.0), start=turned)[0], 0.0, atol=0.02)
    # No controller holds a position in wind that is faster.
    assert_allclose(
        flown((0.0, 0.0, 0.0, 0.0), (0.0, 12.0, 0.0))[0], [0.0, 12.0 - speed], atol=0.02
    )


def test_wind_carries_nothing_on_the_ground():
    rover, drone = (load_scenario('field').robots[name] for name in ('rover', 'east'))
    values = load_scenario('field').content() | {'simulated': {'wind': [2.0, -1.0]}}
    simulation = Simulation(scenario_from_values(values, 'windy'), 1)
    for one in simulation.robots.values():
        assert one.wind.tolist() == [2.0, -1.0, 0.0]
    for _ in range(50):
        simulation.advance()
    assert_array_equal(simulation.robots['rover'].state.pose.position, rover.start)
    assert_allclose(simulation.robots['east'].state.pose.position, drone.start, atol=1e-9)
