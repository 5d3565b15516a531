"""The camera pictures of the page: the part of the image that the sensor counts."""

import base64

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import Image

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.models.pose import Pose
from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.event_log import EventLog
from maasi_sim.run.view.page_file import write_replay
from maasi_sim.run.view.pictures import picture
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


def test_the_page_dims_what_is_not_counted(chromium, tmp_path):
    pose = Pose.from_yaw([1.0, 1.0, 1.0], 0.3)
    message = image_of(ROBOTS['mambo']['camera'], np.array([[1.2, 1.0, 0.0]]), pose)
    content = picture(message, ROBOTS['mambo'], pose, np.zeros((0, 3)))
    state = [0.0, 'robot', 'mambo', [1.0, 1.0, 1.0, 0.3], 1.0, 1, '']
    scene = {'name': 'demo', 'robots': ROBOTS, 'bounds': [[0, 3], [0, 3]]}
    log = EventLog(scene, [state, [0.0, 'picture', 'mambo', *content]])
    write_replay(log, tmp_path / 'page.html')
    with chromium() as shown:
        shown.open((tmp_path / 'page.html').as_uri())
        figure = shown.page.locator('#cameras figure[data-robot=mambo]')
        assert figure.locator('svg path').count() == 2
        assert 'Dimmed' in shown.page.inner_text('#cameras')
        frame, drawn = (figure.locator(part).bounding_box() for part in ('img', 'svg'))
        assert [frame[key] for key in frame] == pytest.approx([drawn[key] for key in drawn], abs=1)
