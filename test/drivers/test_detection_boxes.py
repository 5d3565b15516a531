"""Boxes of a detector of another package: their covariance, and a driver that uses them."""

import math
import re
import sys
from functools import partial

import numpy as np
import pytest
from blue_detector import BlueDetector, box
from marker_view import DISTORTION, turned
from numpy.testing import assert_allclose
from rclpy.node import Node
from rclpy.parameter import Parameter
from robot_team import NANOSECONDS, TURTLEBOT, rendered, stamped, transform
from sensor_msgs.msg import CameraInfo
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection2DArray

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.vision.camera_input import boxes_to_blobs
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.measurement import RangeAndAngles
from maasi_filter.models.pose import Pose
from maasi_filter.ros.qos import LATCHED

# Of Detection2DArray in vision_msgs 4.1.1, the version of Jazzy.
HASH = 'RIHS01_214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968'
# A level camera on a mast, a person of this size [m] in front of it.
LEVEL = {
    'width': 640,
    'height': 480,
    'focal_length': [500.0, 500.0],
    'distortion': DISTORTION,
    'pixel_noise': 0.3,
    'mount': {'position': [0.1, 0.0, 1.5], 'rpy': [0.0, 0.3, 0.0]},
}
TALL, WIDE = 1.7, 0.5


def boxes(*items, frame='', stamp=0):
    message = Detection2DArray(detections=list(items))
    message.header.frame_id = frame
    return stamped(message, stamp)


@pytest.mark.parametrize(('point', 'sides'), [('foot', False), ('centre', False), ('foot', True)])
def test_covariance_covers_the_noise_of_box_and_pose(point, sides):
    """A box is moved by its settings' error as a whole, or, less, each of its sides is."""
    error = 0.1
    settings = CameraSettings.model_validate(
        LEVEL | {'detections': {'point': point, 'error': error}}
    )
    detector, model = MarkerDetector(settings), RangeAndAngles(2)
    generator = np.random.default_rng(901)
    pose_covariance = np.diag([0.03, 0.03, 0.02, 0.004, 0.004, 0.01]) ** 2
    true = Pose.from_yaw([2.0, -1.0, 0.0], 0.7)
    place = true.position + true.rotation() @ [7.0, 1.0, 0.0]
    side = true.rotation() @ [0.0, 0.5 * WIDE, 0.0]
    # What lies flat is at the middle of its box.
    rim = [place + side, place - side, place, [*place[:2], TALL]]
    pixels = detector.camera.project(rim, true)
    size = np.array([pixels[1, 0] - pixels[0, 0], pixels[2, 1] - pixels[3, 1]])
    low = pixels[2] + 0.5 - size * ([0.5, 1.0] if point == 'foot' else [0.5, 0.5])
    nees = []
    for _ in range(2000):
        noise = error * size * generator.standard_normal((2, 2))
        least, most = low + noise[0], low + size + noise[1 if sides else 0]
        message = boxes(box(0.5 * (least + most), most - least))
        blobs, problems = boxes_to_blobs(message, settings)
        assert not problems
        # Corners of pixels are measured too.
        blobs.centroids[:] += generator.normal(0.0, settings.pixel_noise, (1, 2))
        believed = turned(true, np.sqrt(pose_covariance) @ generator.standard_normal(6))
        seen = detector.detect(blobs, believed, pose_covariance)
        expected = model.measure(place[None, :2], believed)[0]
        offset = model.residual(seen.values[0], expected)
        nees.append(offset @ np.linalg.solve(seen.covariances[0], offset))
    least, most = (1.5, 1.97) if sides else (1.87, 2.13)
    assert least < np.mean(nees) < most


def test_a_box_is_at_its_foot_or_centre_and_a_cut_one_is_less_exact():
    settings = CameraSettings.model_validate(LEVEL | {'detections': {'error': 0.1}})
    whole, turned_box, cut = (320, 300), (100, 100), (20, 400)
    message = boxes(
        box(whole, (40, 80)), box(turned_box, (40, 80), None, 0.5 * math.pi), box(cut, (60, 50))
    )
    blobs, problems = boxes_to_blobs(message, settings)
    assert not problems
    assert_allclose(blobs.centroids, [[319.5, 339.5], [99.5, 119.5], [24.5, 424.5]], atol=1e-9)
    deviations = np.sqrt(np.diagonal(blobs.covariances, axis1=1, axis2=2))
    assert_allclose(deviations, [[4.0, 8.0], [8.0, 4.0], [25.0, 25.0]], atol=1e-9)
    assert blobs.border_cut.tolist() == [False, False, True]
    assert [(item.class_id, item.score) for item in blobs.labels] == [
        ('person', 0.75), ('', 0.0), ('person', 0.75),
    ]  # fmt: skip
    # In 3D they are on the floor as well.
    seen = MarkerDetector(settings, 3).detect(blobs, Pose(np.zeros(3)))
    assert seen.values.shape == (3, 3) and not seen.positions[:, 2].any()
    assert np.linalg.eigvalsh(seen.covariances).min() > 0.0
    # A tracker's id is none of the target's.
    assert not any(item.identity for item in blobs.labels)
    above = boxes(box((320, 20), (10, 10)))
    seen = MarkerDetector(settings).detect(boxes_to_blobs(above, settings)[0], Pose(np.zeros(3)))
    assert seen.dropped['not on the floor'] == 1 and not len(seen.values)


@pytest.mark.parametrize(
    ('item', 'said'),
    [
        (box((700, 100), (10, 10)), 'bbox: read .*inside 640 x 480 px'),
        (box((-1, 100), (10, 10)), 'bbox'),
        (box((math.nan, 100), (10, 10)), 'bbox'),
        (box((100, 100), (10, math.inf)), 'bbox'),
        (box((100, 100), (0, 10)), 'sizes above 0'),
        (box((100, 100), (10, 10), theta=math.inf), 'finite theta'),
        (box((100, 100), (10, 10), ('person', 1.5)), 'score'),
        (box((100, 100), (10, 10), ('a' * 101, 0.9)), 'class_id'),
        (box((0.5, 0.4), (0.1, 0.2)), r'bbox: .*normalised.*pixels of 640 x 480'),
        (box((0.5, 1.0), (1.0, 0.2)), 'normalised'),
    ],
)
def test_a_bad_box_is_named_and_the_others_are_used(item, said):
    settings = CameraSettings.model_validate(LEVEL | {'detections': {}})
    good = box((100, 100), (10, 10))
    blobs, (problem,) = boxes_to_blobs(boxes(good, item, good), settings)
    assert len(blobs) == 2
    assert re.search(said, problem)


@pytest.mark.parametrize('seed', range(20))
def test_one_bad_hypothesis_costs_no_other_and_rounding_costs_none(seed):
    generator = np.random.default_rng([46, seed])
    settings = CameraSettings.model_validate(LEVEL | {'detections': {}})
    scores = generator.uniform(0.0, 0.9, 6).tolist()
    scores[generator.integers(6)] = best = float(generator.choice([1.0, 1.0000001, 1.0 + 5e-7]))
    expected = f'c{scores.index(best)}'
    item = box((100, 100), (10, 10), None)
    bad = generator.integers(0, 7)
    for number, score in enumerate(scores):
        if number == bad:
            item.results += box((0, 0), (1, 1), ('broken', math.nan)).results[1:]
        item.results += box((0, 0), (1, 1), (f'c{number}', score)).results[1:]
    blobs, problems = boxes_to_blobs(boxes(item), settings)
    assert [(label.class_id, label.score) for label in blobs.labels] == [(expected, 1.0)]
    assert len(problems) == (bad < 6) and all('nan' in problem for problem in problems)
    only = box((100, 100), (10, 10), None)
    only.results += box((0, 0), (1, 1), ('broken', math.nan)).results[1:]
    blobs, problems = boxes_to_blobs(boxes(only), settings)
    assert not len(blobs) and len(problems) == 1


def with_boxes(**changes):
    detections = {'classes': ['person'], 'point': 'centre'} | changes
    return TURTLEBOT['camera'] | {'detections': detections}


@pytest.fixture
def searching(play, start_node):
    """Return a detector in the loop, the driver, the team, and how to look at targets."""
    detector = BlueDetector(start_node(partial(Node, 'detector')))
    driver, team = play(camera=with_boxes())
    team.until(detector.publisher.get_subscription_count)
    team.move(4)

    def look(*offsets, view=None):
        """Show targets at offsets from the robot, front and left [m]; return what is detected."""
        team.move()
        pose, count = team.body.robot_state().pose, len(team.detections)
        places = [pose.position + pose.rotation() @ [*offset, 0.0] for offset in offsets]
        image = rendered(view or team, [place[:2].tolist() for place in places], pose)
        stamp = team.step * NANOSECONDS
        team.images.publish(stamped(image, stamp))
        team.ask(stamp)
        team.move()
        answer = team.answer(count + 1)
        seen = [(item.range, item.bearing - pose.yaw) for item in answer.detections]
        return answer, [[r * math.cos(b), r * math.sin(b)] for r, b in seen]

    return detector, driver, team, look


def test_a_detector_of_another_package_needs_no_code(searching):
    detector, driver, team, look = searching
    detector.frame = 'rover/camera_optical'
    places = [[0.12, 0.03], [0.02, -0.05]]
    answer, seen = look(*places)
    assert_allclose(sorted(seen), sorted(places), atol=4e-3)
    assert {(item.class_id, item.score, item.identity) for item in answer.detections} == {
        ('person', 0.75, '')
    }
    assert all(len(item.covariance) == 4 for item in answer.detections)
    # Seeing nothing is an answer, too; frames without a name are those of the camera.
    detector.frame = ''
    assert not look()[0].detections
    # A calibration replaces that of the settings.
    info = CameraInfo(width=160, height=120, distortion_model='plumb_bob')
    info.k = [240.0, 0.0, 79.5, 0.0, 240.0, 59.5, 0.0, 0.0, 1.0]
    team.until(team.calibrations.get_subscription_count)
    team.calibrations.publish(info)
    team.until(lambda: driver.sensor_input.camera.focal_length == [240.0, 240.0])
    assert_allclose(look([0.13, 0.05])[1], [[0.09, 0.05]], atol=4e-3)
    hashes = {
        f'RIHS01_{bytes(item.topic_type_hash.value).hex()}'
        for item in team.get_publishers_info_by_topic('/rover/camera/detections')
    }
    assert hashes == {HASH}


def test_a_camera_that_turns_on_the_robot_is_where_tf_says(searching):
    detector, driver, team, look = searching
    # An optical frame, looking down with the image's top to the left.
    place = [0.1, 0.02, 0.3]
    optical = Pose.from_rpy(place, [math.pi, 0.0, 0.0])
    message = TFMessage(transforms=[transform('rover/base_link', 'gimbal', optical)])
    publisher = team.create_publisher(TFMessage, '/tf_static', LATCHED)
    detector.frame = 'gimbal'
    team.ask(team.step * NANOSECONDS)
    team.images.publish(stamped(rendered(team, [], team.start), team.step * NANOSECONDS))
    team.until(lambda: driver.dropped['image'] == 1)
    # Once tf knows the frame, the next image answers.
    publisher.publish(message)
    team.until(lambda: 'gimbal' in driver.frames._buffer._edges)
    team.move()
    mount = {'position': place, 'rpy': [0.0, 0.5 * math.pi, 0.5 * math.pi]}
    settings = DriverSettings.model_validate(
        TURTLEBOT | {'camera': with_boxes() | {'mount': mount}}
    )
    view = type('View', (), {'settings': settings})
    expected = [0.12, 0.05]
    _, seen = look(expected, view=view)
    assert_allclose(seen[-1:], [expected], atol=4e-3)


def test_boxes_of_other_classes_are_reported_with_the_classes_seen(searching, capfd):
    _, driver, team, _ = searching
    for labels, said in (
        ([('0', 0.9), ('Person', 0.8)], "'person'; received are '0', 'Person', 'dog'"),
        ([('0', 0.9)], ''),  # said already
        ([('2', 0.9)], "received are '0', '2', 'Person', 'dog'"),
        ([('person', 0.9)], ''),
        ([('3', 0.9)], ''),  # the classes are right, others may be there
    ):
        team.move()
        message = boxes(*(box((80, 60), (20, 20), label) for label in labels))
        driver.sensor_input._on_boxes(stamped(message, team.step * NANOSECONDS))
        warned = capfd.readouterr().err
        assert (said in warned) if said else ('received are' not in warned)


def test_boxes_in_the_frame_of_the_body_are_refused(searching, capfd):
    _, driver, team, _ = searching
    for frame in ('rover/base_link', 'camera_link'):
        # A body's axes, a little tilted: z is up.
        turn = Pose.from_rpy([0.1, 0.0, 0.3], [0.0, 0.4, 0.2])
        if frame == 'camera_link':
            message = TFMessage(transforms=[transform('rover/base_link', frame, turn)])
            team.create_publisher(TFMessage, '/tf_static', LATCHED).publish(message)
            team.until(lambda: 'camera_link' in driver.frames._buffer._edges)
        stamp = team.step * NANOSECONDS
        with pytest.raises(ValueError, match=rf'{frame}.*z axis points up.*optical frame'):
            driver.sensor_input._placed(frame, stamp)


def test_without_vision_msgs_boxes_are_refused_and_all_else_works(play, monkeypatch):
    monkeypatch.setitem(sys.modules, 'vision_msgs.msg', None)
    driver, _ = play()
    for transition in ('deactivate', 'cleanup'):
        assert getattr(driver, f'trigger_{transition}')().name == 'SUCCESS'
    driver.set_parameters([Parameter('camera.detections.point', value='foot')])
    assert driver.trigger_configure().name == 'FAILURE'
    assert 'vision_msgs is not installed' in driver.problem
