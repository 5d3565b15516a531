"""The camera pictures of the page: the part of the image that the sensor counts."""

import base64

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import Image

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.models.pose import Pose
from maasi_filter.records import FoundTarget
from maasi_sim.run import facts
from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.pictures import cut_out, picture
from maasi_sim.run.view.scene import scene_of

ROBOTS = scene_of('demo', load_mission('mambo_turtlebot').scenario)['robots']


def image_of(camera, positions, pose):
    """Return a message with a white image on which discs are blue, at positions on the floor."""
    model = Camera.from_settings(CameraSettings(**camera))
    size = model.width, model.height
    pixels = np.full((size[1], size[0], 3), 255, np.uint8)
    for column, row in model.project(positions, pose):
        if np.isfinite([column, row]).all() and abs(column) < 9999 and abs(row) < 9999:
            cv2.circle(pixels, (round(column), round(row)), 6, (0, 0, 255), -1)
    message = Image(height=size[1], width=size[0], encoding='rgb8', step=3 * size[0])
    message.data = pixels.tobytes()
    return message


@pytest.mark.parametrize('name', ['mambo', 'turtlebot'])
@pytest.mark.parametrize('seed', range(5))
def test_what_is_outside_of_the_sensors_box_is_cut_or_outside_of_the_outline(name, seed):
    rng = np.random.default_rng(seed)
    robot = ROBOTS[name]
    view = robot['view']
    assert view['kind'] == 'box' and view['turns']
    yaw = float(rng.uniform(-3.0, 3.0))
    pose = Pose.from_yaw([*rng.uniform(0.5, 2.0, 2), 1.0 if name == 'mambo' else 0.0], yaw)
    low, high = np.array(view['lower'][:2]), np.array(view['upper'][:2])
    offsets = rng.uniform(low - 0.4 * (high - low), high + 0.4 * (high - low), (40, 2))
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    floor = np.column_stack([offsets @ turn + pose.position[:2], np.zeros(40)])
    counted = ((offsets > low + 0.03) & (offsets < high - 0.03)).all(axis=1)
    outside = ((offsets < low - 0.03) | (offsets > high + 0.03)).any(axis=1)
    level = floor - np.append(pose.position[:2], 0.0)
    reach = np.linalg.norm(floor - pose.position, axis=1)
    bearings = np.arctan2(level[:, 1], level[:, 0])
    values = np.stack([reach, bearings, np.arcsin(-pose.position[2] / reach)], axis=1)
    model = Camera.from_settings(CameraSettings(**robot['camera']))
    pixels = model.project(floor, pose)
    inside_image = (pixels > 2).all(axis=1) & (pixels < (model.width - 3, model.height - 3)).all(1)
    for index in np.flatnonzero(inside_image & (counted | outside)):
        message = image_of(robot['camera'], floor[[index]], pose)
        data, size, marks, outline = picture(message, robot, pose, values[[index]])
        shown = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert shown.shape[1] <= 240 and len(marks) == 1
        ring = np.array(outline, np.float32).reshape(-1, 1, 2)
        assert len(ring)
        column, row, _ = marks[0]
        within = cv2.pointPolygonTest(ring, (column + 0.5, row + 0.5), True)
        assert (within > -1.5) if counted[index] else (within < 1.5)
        if counted[index]:
            # The mark is where the disc is in what is shown.
            scale = shown.shape[1] / size[0]
            blue, _, red = shown[int(row * scale), int(column * scale)].astype(int)
            assert blue > red + 50


def test_a_sensor_without_a_box_or_a_robot_without_a_camera_has_the_whole_image():
    camera, pose = ROBOTS['mambo']['camera'], Pose.from_yaw([1.0, 1.0, 1.0], 0.3)
    message = image_of(camera, np.array([[1.2, 1.0, 0.0]]), pose)
    whole = [message.width, message.height]
    robots = ({}, {'camera': camera}, {'camera': camera, 'view': {'kind': 'gaussian'}})
    for robot in robots:
        _, size, marks, outline = picture(message, robot, pose, np.zeros((0, 3)))
        assert size == whole and outline == [] and (marks is None) == (not robot)


def test_the_page_dims_what_is_not_counted(chromium):
    pose = Pose.from_yaw([1.0, 1.0, 1.0], 0.3)
    message = image_of(ROBOTS['mambo']['camera'], np.array([[1.2, 1.0, 0.0]]), pose)
    content = picture(message, ROBOTS['mambo'], pose, np.zeros((0, 3)))
    state = [0.0, 'robot', 'mambo', [1.0, 1.0, 1.0, 0.3], 1.0, 1, '']
    scene = {'name': 'demo', 'robots': ROBOTS, 'bounds': [[0, 3], [0, 3]]}
    with chromium() as shown:
        shown.show(scene, state, [0.0, 'picture', 'mambo', *content])
        figure = shown.page.locator('#cameras figure[data-robot=mambo]')
        assert figure.locator('svg path').count() == 2
        assert 'Dimmed' in shown.page.inner_text('#cameras')
        frame, drawn = (figure.locator(part).bounding_box() for part in ('img', 'svg'))
        assert [frame[key] for key in frame] == pytest.approx([drawn[key] for key in drawn], abs=1)


def seen_position(rng, robot, pose):
    """Return a position on the floor that is in the image."""
    model = Camera.from_settings(CameraSettings(**robot['camera']))
    while True:
        floor = np.append(pose.position[:2] + rng.uniform(-0.3, 0.3, 2), 0.0)
        pixel = model.project(floor[None], pose)[0]
        if (pixel > 30).all() and (pixel < (model.width - 30, model.height - 30)).all():
            return floor


def test_a_find_has_the_picture_of_the_measurement_that_completed_it():
    rng, robot, events = np.random.default_rng(1), ROBOTS['mambo'], []
    maker = EventMaker(scene_of('demo', load_mission('mambo_turtlebot').scenario), events.append)
    pose = Pose.from_yaw([1.0, 1.0, 1.0], 0.3)
    floor = seen_position(rng, robot, pose)
    for index, place in ((3, floor), (4, floor + 0.1)):
        message = image_of(robot['camera'], place[None], pose)
        seen = facts.Measured(float(index), 'mambo', pose.position, pose, [], None, index)
        maker.add(facts.Photographed(seen.time, seen, message))
        if index == 3:
            expected = cut_out(message, robot, pose, floor.round(3))
    found = [FoundTarget(1, floor[:2].round(3), np.eye(2), 'mambo', 3, 5.0)]
    # Found by a robot without an image.
    found.append(FoundTarget(2, floor[:2], np.eye(2), 'turtlebot', 1, 5.0))
    maker.add(facts.Found(5.0, '', found, 1))
    maker.add(facts.Found(6.0, '', found, 2))
    assert [event[3:] for event in events if event[1] == 'crop'] == [[1, expected]]
    # Another robot flies over it later.
    at = np.append(floor[:2], 1.2)
    pose = Pose.from_yaw(at, 0.0)
    seen = facts.Measured(7.0, 'mambo', at, pose, [], None, 9)
    maker.add(facts.Photographed(7.0, seen, image_of(robot['camera'], floor[None], pose)))
    assert [event[:4] for event in events if event[1] == 'crop'][1:] == [[7.0, 'crop', '', 2]]


@pytest.mark.parametrize('seed', range(6))
def test_the_picture_of_a_target_is_the_part_of_the_image_around_it(seed):
    rng = np.random.default_rng(seed)
    robot = ROBOTS['mambo']
    pose = Pose.from_yaw([1.0, 1.0, float(rng.uniform(0.7, 1.5))], float(rng.uniform(-3.0, 3.0)))
    floor = seen_position(rng, robot, pose)
    message = image_of(robot['camera'], floor[None], pose)
    data = base64.b64decode(cut_out(message, robot, pose, floor))
    assert len(data) < 8000
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(int)
    assert max(shown.shape[:2]) <= 96
    # Blue, and in its middle unless the image ends there.
    rows, columns = np.nonzero((shown[:, :, 0] > 150) & (shown[:, :, 2] < 100))
    model = Camera.from_settings(CameraSettings(**robot['camera']))
    column, row = model.project(floor[None], pose)[0]
    assert len(rows) > 20
    if 40 < column < model.width - 40 and 40 < row < model.height - 40:
        assert abs(rows.mean() - 0.5 * shown.shape[0]) < 3.0
        assert abs(columns.mean() - 0.5 * shown.shape[1]) < 3.0
    # Not in the image, behind the camera, or without a camera.
    far, above = np.array([50.0, 0.0, 0.0]), np.array([0.0, 0.0, 5.0])
    assert cut_out(message, robot, pose, floor + far) is None
    assert cut_out(message, robot, pose, pose.position + above) is None
    assert cut_out(message, {}, pose, floor) is None
