"""Drivers with the messages that ros_gz_bridge makes of a world of `run_scenario --write-world`.

As its sources have them (a4d00a9): publishers and subscribers keep the last 10 messages, reliable;
`convert` copies stamp, frame_id and pixels. gz-sim's OdometryPublisher gives poses in the world and
twists in the axes of the robot; VelocityControl moves it as `cmd_vel` says.
"""

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from numpy.testing import assert_allclose
from rclpy.qos import QoSProfile
from robot_team import NANOSECONDS, rendered, stamped
from sensor_msgs.msg import CameraInfo, Image

from maasi_drivers import drivers
from maasi_drivers.settings.driver import DrivenRobot, DriverSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import pose_from_ros
from maasi_sim.scenario.gazebo_world import bridge_text
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.simulation.sim_topics import camera_messages

BRIDGE = QoSProfile(depth=10)
TYPES = {
    'nav_msgs/msg/Odometry': Odometry,
    'sensor_msgs/msg/Image': Image,
    'sensor_msgs/msg/CameraInfo': CameraInfo,
    'geometry_msgs/msg/TwistStamped': TwistStamped,
}
ROBOTS = {
    'turtlebot3_burger': ('TurtlebotDriver', [0.5, 0.6, 0.0], [0.9, 0.9, 0.0]),
    'mambo': ('MamboDriver', [1.0, 1.0, 1.0], [1.4, 0.8, 1.0]),
}


def scenario(kind, start):
    robot = {'type': kind, 'start': start, 'yaw': 0.4, 'body': 'external', 'camera': 'external'}
    return scenario_from_values(
        {
            'version': 1,
            'environment': {'bounds': [[-0.3, 2.4], [-0.3, 2.4]]},
            'step': 1e-9 * NANOSECONDS,
            'targets': {'count': 1, 'margin': 0.5},
            'robots': {'rover': robot},
            'stop': 'planner_done',
            'limits': {'time': 60.0},
        },
        'made',
    )


@pytest.mark.parametrize('kind', ROBOTS)
def test_it_moves_and_measures_by_the_topics_of_the_bridge(play, kind):
    driver, start, goal = ROBOTS[kind]
    made = scenario(kind, start)
    settings = DriverSettings.model_validate(
        {
            'environment': made.environment,
            'step': made.step,
            'odometry_timeout': 30.0,
            'sensor_timeout': 0.0,
            **DrivenRobot.part_of(made.robots['rover']),
        }
    ).model_dump()
    driver, team = play((getattr(drivers, driver), settings))
    topics = {item['ros_topic_name']: item for item in yaml.safe_load(bridge_text(made))}
    sent = {}
    for name, topic in topics.items():
        if name == '/clock':
            continue
        message = TYPES.get(topic['ros_type_name'])
        if message is None:  # the scan, which these drivers do not use
            assert name == '/rover/scan'
        elif topic['direction'] == 'ROS_TO_GZ':
            team.commands.clear()
            team.create_subscription(message, name, team.commands.append, BRIDGE)
        else:
            sent[message] = team.create_publisher(message, name, BRIDGE)
    # Poses in the world.
    team.odometry_frame, team.start = 'map', Pose(np.zeros(3))
    team.odometry, team.images = sent[Odometry], sent[Image]
    team.until(lambda: all(item.get_subscription_count() for item in sent.values()))
    team.awaken()
    team.move()
    assert_allclose(pose_from_ros(team.state.pose.pose).position, start, atol=1e-9)
    _, result = team.send_accepted(goal)
    team.until(lambda: team.move() or result.done())
    assert result.result().result.reached, result.result().result.reason
    assert np.linalg.norm((team.position - goal)[:2]) < 0.1
    # The calibration of Gazebo, whose pixels begin at the corner of the image.
    camera = made.robots['rover'].camera
    _, info = camera_messages(camera, 'rover/camera_optical')
    info.k[2] += 0.5
    info.k[5] += 0.5
    sent[CameraInfo].publish(info)
    team.until(lambda: driver.sensor_input.camera.principal_point == [info.k[2], info.k[5]])
    # A marker in its view, as a camera of Gazebo sees it.
    team.move()
    pose, stamp = team.body.robot_state().pose, team.step * NANOSECONDS
    view = settings['sensor']['detection']
    ahead = 0.5 * (np.array(view['lower'][:2]) + np.array(view['upper'][:2]))
    target = (pose.rotation() @ [*ahead, 0.0] + pose.position)[:2]
    image = stamped(rendered(team, [target.tolist()], pose), stamp)
    image.header.frame_id = 'rover/camera_optical'
    team.images.publish(image)
    team.ask(stamp)
    half_a_pixel = 0.5 / info.k[0] * np.linalg.norm([*target, 0.0] - pose.position)
    assert_allclose(team.seen_at(), target, atol=5e-3 + 2.0 * half_a_pixel)
    assert not driver.dropped
