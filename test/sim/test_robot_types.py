"""The types of robots in config/robots."""

import numpy as np
import pytest
from test_scenario import changed

from maasi_drivers.vision.camera_model import Camera, box_view_margin
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.search import search

TURTLEBOTS = {
    # Largest speed [m/s] and turning rate [rad/s] of the robot, by its data sheet.
    'turtlebot3_burger': (0.22, 2.84),
    'turtlebot3_waffle': (0.26, 1.82),
    'turtlebot3_waffle_pi': (0.26, 1.82),
}


def scenario(kind, height=0.0):
    robot = ('robots', {'rover': {'type': kind, 'start': [0.5, 0.5, height]}})
    targets = ('targets', {'count': 2, 'separation': 0.2, 'margin': 0.1})
    values = changed(robot, targets, ('filter.method', 'pmb'), ('limits.time', 400.0))
    return scenario_from_values(values, 'test')


@pytest.mark.parametrize('kind', [*TURTLEBOTS, 'mambo'])
def test_a_marker_in_the_field_of_view_is_in_the_image_as_a_whole(kind):
    robot = scenario(kind, 1.0 if kind == 'mambo' else 0.0).robots['rover']
    box, radius = robot.sensor.detection, 0.5 * robot.camera.marker_diameter
    lower, upper = np.array(box.lower) - radius, np.array(box.upper) + radius
    camera = Camera.from_settings(robot.camera)
    assert box_view_margin(camera, lower, upper, robot.start[2]) > 0.0


def test_turtlebots_keep_their_limits():
    for kind, (speed, turn) in TURTLEBOTS.items():
        motion = scenario(kind).robots['rover'].motion
        assert motion.speed <= speed and motion.yaw_rate <= turn


# The camera of a Waffle is that of a Waffle Pi but for numbers.
@pytest.mark.parametrize('kind', ['turtlebot3_burger', 'turtlebot3_waffle_pi'])
def test_a_turtlebot_finds_markers(kind):
    result = search(scenario(kind), seed=2)
    assert result.end_reason == 'all_found'
    assert result.rmse < 0.015
