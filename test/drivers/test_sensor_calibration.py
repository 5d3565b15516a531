"""A sensor's noise R from recordings of one target."""

import io
import json
import shutil
from contextlib import redirect_stdout

import numpy as np
import pytest
import yaml
from nav_msgs.msg import Odometry
from numpy.testing import assert_allclose
from rclpy.serialization import serialize_message
from robot_team import image_message

from maasi_drivers.calibrate_sensor import main
from maasi_drivers.calibration.sensor_calibration import Observation, sensor_noise
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import detections_to_ros, pose_to_ros, stamp_to_ros
from maasi_filter.ros.parameters import flatten
from maasi_filter.settings import SensorSettings
from maasi_msgs.msg import AgentState, DetectionArray
from maasi_sim.run.bag import BagWriter, load_types
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.simulation.robots import Simulation

TARGET = [0.8, 0.9]
AT_TARGET = ['--target', *map(str, TARGET)]
NOISE, HEADING_NOISE = 0.008, 0.02
LATE = 0.05  # stamps of the recorded images are late by so much [s]


# ---- from observations to R ------------------------------------------------------------------


def observations_of(target, deviations, number, seed, sensor, spread=0.2, height=0.0):
    generator = np.random.default_rng(seed)
    observations = []
    for _ in range(number):
        place = np.zeros(3)
        place[: len(target)] = target + generator.uniform(-spread, spread, len(target))
        place[2] += height
        pose = Pose.from_yaw(place, generator.uniform(-3.0, 3.0))
        exact = sensor.measurement.measure(np.atleast_2d(target), pose)
        noise = generator.normal(0.0, deviations, exact.shape)
        observations.append(Observation(pose, exact + noise))
    return observations


def sensor_of(dimension, **settings):
    return SensorSettings.model_validate(settings).build('rover', dimension)


def test_a_known_covariance_is_found_again_in_3d():
    target, deviations = np.array([9.0, 12.0, 7.0]), [1.5, 0.175, 0.295]
    sensor = sensor_of(3, detection={'size': [25.0, 25.0, 25.0]})
    observations = observations_of(target, deviations, 2000, 3, sensor, spread=6.0)
    # Bearings from all around: their errors are small across pi, too.
    noise = sensor_noise(observations, sensor, target)
    assert_allclose(noise.deviations, deviations, rtol=0.06)
    correlation = noise.covariance / np.outer(noise.deviations, noise.deviations)
    assert np.abs(correlation - np.eye(3)).max() < 0.08
    assert np.abs(noise.bias).max() < 0.1
    assert noise.used == 2000
    searched = sensor_noise(observations, sensor)
    assert_allclose(searched.target, target, atol=0.3)
    assert_allclose(searched.deviations, deviations, rtol=0.1)


def test_misses_and_other_things_are_counted_and_not_part_of_r():
    sensor = sensor_of(2, detection={'kind': 'box', 'lower': [-1, -1], 'upper': [1, 1]})
    target = np.array([1.0, 2.0])
    observations = observations_of(target, [0.01, 0.03], 400, 4, sensor, spread=0.5)
    generator = np.random.default_rng(5)
    for i in range(0, 400, 10):
        observations[i] = Observation(observations[i].pose, np.zeros((0, 2)))
        other = observations[i + 5]
        false = [[generator.uniform(0.5, 0.9), generator.uniform(-3, 3)]]
        observations[i + 5] = Observation(other.pose, np.concatenate([false, other.values]))
    noise = sensor_noise(observations, sensor)
    assert_allclose(noise.deviations, [0.01, 0.03], rtol=0.15)
    assert (noise.inside, noise.missed, noise.others) == (400, 40, 40)
    assert noise.probability == pytest.approx(0.9)
    assert noise.used + noise.near == 360
    for few in (9, 0):
        with pytest.raises(ValueError, match=r'detected . times.* allowed is at least 10'):
            sensor_noise(observations[:few], sensor)


# ---- from a recording to R -------------------------------------------------------------------


def single_target():
    odometry = {'position_noise': NOISE, 'heading_noise': HEADING_NOISE}
    robot = {
        'type': 'mambo',
        'start': [0.7, 0.7, 1.0],
        'yaw': 0.4,
        'candidates': {'grid': [4, 4], 'spacing': 0.3, 'corner': [0.3, 0.3]},
        'odometry': odometry | {'position_drift': 0.0, 'heading_drift': 0.0},
        'camera': {'stamp_offset': -LATE},
    }
    values = {
        'version': 1,
        'environment': {'bounds': [[-0.3, 2.4], [-0.3, 2.4]]},
        'targets': {'positions': [TARGET]},
        'robots': {'mambo': robot},
    }
    return scenario_from_values(values, 'test')


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """Record a drone that hovers about over one target; return the folder, and what is true."""
    folder = tmp_path_factory.mktemp('calibration')
    scenario = single_target()
    simulation = Simulation(scenario, 7)
    robot = simulation.robots['mambo']
    generator = np.random.default_rng(8)
    ranges = []
    with BagWriter(folder / 'bag', load_types(), images='png') as writer:
        writer.add_topic('/mambo/odom', 'nav_msgs/msg/Odometry')
        writer.add_topic('/mambo/camera/image_raw', 'sensor_msgs/msg/Image')
        waypoint = np.array(TARGET)
        for step in range(700):
            simulation.advance()
            place = robot.state.pose.position
            if step % 30 == 0:
                waypoint = TARGET + generator.uniform(-0.18, 0.18, 2)
            robot.command([*np.clip(1.5 * (waypoint - place[:2]), -0.4, 0.4), 0.0, 0.0])
            now = round(1e9 * simulation.time)
            odometry = Odometry()
            odometry.header.stamp = stamp_to_ros(now)
            odometry.pose.pose = pose_to_ros(robot.odometry.pose)
            writer.write('/mambo/odom', now, serialize_message(odometry))
            if simulation.images_due('mambo'):
                image = robot.image(simulation.step, simulation.time)
                message = image_message(image, now + round(1e9 * LATE))
                writer.write('/mambo/camera/image_raw', now + 1, serialize_message(message))
                ranges.append(float(np.linalg.norm(place[:2] - TARGET)))
    write_parameters(folder / 'driver.yaml', scenario)
    return folder, np.array(ranges)


def write_parameters(path, scenario, **changes):
    robot = scenario.robots['mambo']
    settings = DriverSettings(
        environment=scenario.environment,
        start=robot.start,
        yaw=robot.yaw,
        sensor=robot.sensor,
        camera=robot.camera,
    )
    content = flatten(settings) | {'use_sim_time': True} | changes
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': content}}))


def calibrate(folder, *arguments, parameters='driver.yaml'):
    """Return the result of the command, with what it printed as `said`."""
    result = folder / 'result.json'
    words = [str(folder), '--parameters', str(folder / parameters), '--json', str(result)]
    with redirect_stdout(io.StringIO()) as said:
        assert main([*words, *arguments]) == 0
    return json.loads(result.read_text()) | {'said': said.getvalue()}


@pytest.fixture(scope='module')
def whole(recording):
    """Return the result for the whole recording, with the target given."""
    return calibrate(recording[0], *AT_TARGET)


@pytest.mark.parametrize('given', [True, False])
def test_r_of_a_recorded_flight_is_that_of_its_odometry(recording, whole, given):
    folder, ranges = recording
    noise = whole if given else calibrate(folder)
    far = ranges[ranges >= 0.05]
    # The errors of the pose: the image's are a tenth of them.
    expected = [NOISE, np.sqrt(np.mean((NOISE / far) ** 2) + HEADING_NOISE**2)]
    assert_allclose(noise['deviations'], expected, rtol=0.2)
    assert_allclose(noise['target'], TARGET, atol=0.003)
    assert noise['used'] > 0.95 * len(far)
    assert noise['missed'] <= 0.02 * noise['inside']
    said = noise['said']
    assert 'poses of /mambo/odom' in said
    snippet = yaml.safe_load(said[said.index('sensor:') :])
    SensorSettings.model_validate(snippet['sensor'])
    assert snippet['sensor']['noise']['range'] == pytest.approx(noise['deviations'][0], rel=1e-3)


def test_a_wrong_stamp_offset_and_a_target_at_the_wrong_place_show(recording, whole):
    folder, _ = recording
    write_parameters(folder / 'late.yaml', single_target(), **{'camera.stamp_offset': 0.1})
    wrong = calibrate(folder, *AT_TARGET, parameters='late.yaml')
    assert wrong['deviations'][0] > 1.5 * whole['deviations'][0]
    elsewhere = calibrate(folder, '--target', '0.83', '0.9')
    assert 'check mount, stamp_offset, start and target' in elsewhere['said']


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--robot', 'rover'], ['robot: found none', '/mambo/odom']),
        (['--use', 'detections'], ['found none with detections']),
        (['--poses', '/nowhere'], ['poses: /nowhere is not recorded']),
        (['--poses', '/mambo/camera/image_raw/compressed'], ['allowed are AgentState']),
        (['--target', '1', 'nan'], ['target: got [1.0, nan]', '2 finite numbers']),
        (['--least-range', '5'], ['detected 0 times', 'at least 10']),
        ('- 1\n', ['not a parameter file']),
        ('/**: {ros__parameters: {camera.widht: 5}}\n', ['widht: ']),
        ('/**: {ros__parameters: {camera.width: 5}}\n', ['camera.width: read 5', 'allowed is']),
        (None, ['driver.yaml']),
    ],
)
def test_what_is_wrong_is_said(recording, tmp_path, capsys, arguments, words):
    folder, _ = recording
    if isinstance(arguments, list):
        file = folder / 'driver.yaml'
    else:
        file, text, arguments = tmp_path / 'driver.yaml', arguments, []
        if text is not None:
            file.write_text(text)
    assert main([str(folder), '--parameters', str(file), *arguments]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words), said
    if arguments == []:
        assert main([str(tmp_path / 'none'), '--parameters', str(folder / 'driver.yaml')]) == 2


def test_detections_of_a_driver_do_as_well(tmp_path):
    """For robots that segment on board, or range: there are no images to record."""
    scenario = single_target()
    sensor = scenario.robots['mambo'].sensor.build('mambo', 2)
    observations = observations_of(np.array(TARGET), [0.011, 0.03], 300, 9, sensor, height=1.0)
    with BagWriter(tmp_path / 'bag', load_types()) as writer:
        writer.add_topic('/mambo/detections', 'maasi_msgs/msg/DetectionArray')
        writer.add_topic('/mambo/state', 'maasi_msgs/msg/AgentState')
        writer.write('/mambo/state', 0, serialize_message(AgentState()))
        for number, observation in enumerate(observations):
            message = DetectionArray(detections=detections_to_ros(observation.values, None, ()))
            message.pose.pose = pose_to_ros(observation.pose)
            writer.write('/mambo/detections', number, serialize_message(message))
    write_parameters(tmp_path / 'driver.yaml', scenario)
    noise = calibrate(tmp_path, *AT_TARGET)
    assert_allclose(noise['deviations'], [0.011, 0.03], rtol=0.15)
    assert 'detections used' in noise['said']


def cut(share):
    return lambda data: data[: int(share * len(data))]


def zeros_inside(data):
    # The start of a compressed chunk.
    middle = data.index(b'\x28\xb5\x2f\xfd', len(data) // 2)
    return data[:middle] + bytes(4) + data[middle + 4 :]


@pytest.mark.parametrize(
    ('damage', 'text'),
    [
        (cut(0.8), 'is missing'),
        (zeros_inside, 'is damaged'),
        *((cut(share), None) for share in (0.0, 0.00002, 0.02)),
    ],
)
def test_of_a_damaged_recording_what_is_readable_is_used(
    recording, whole, tmp_path, capsys, damage, text
):
    folder = shutil.copytree(recording[0], tmp_path / 'damaged')
    (file,) = (folder / 'bag').glob('*.mcap')
    file.write_bytes(damage(file.read_bytes()))
    if text is None:
        # Where too little is left, one error is said.
        assert main([str(folder), '--parameters', str(folder / 'driver.yaml'), *AT_TARGET]) == 2
        starts = [line.partition(':')[0] for line in capsys.readouterr().err.splitlines()]
        assert starts[-1] == 'error' and len(starts) <= 2
        return
    noise = calibrate(folder, *AT_TARGET)
    assert text in capsys.readouterr().err
    assert 0.3 * whole['used'] < noise['used'] < whole['used']
    assert_allclose(noise['deviations'], whole['deviations'], rtol=0.5)
