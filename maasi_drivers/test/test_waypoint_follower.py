"""What a robot does about its goal."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus, WaypointFollower
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.settings import MotionSettings


def follower_of(model='unicycle'):
    return WaypointFollower(make_motion(MotionSettings(model=model, speed=0.2, tolerance=0.05)))


def at(x, y=0.0, z=1.0):
    return RobotState.at_rest([x, y, z])


def goal(x, tolerance=0.0):
    return Goal(1, 0, np.array([x, 0.0, 1.0]), tolerance)


def test_a_ground_robot_reaches_its_goal_in_the_step_in_which_it_is_there():
    follower = follower_of()
    assert follower.update(at(0.3))[0].tolist() == [0.0] * 4 and follower.status == GoalStatus.IDLE
    target = goal(1.0)
    assert follower.adopt(target) is None
    command, reached = follower.update(at(0.0))
    assert command[0] > 0.1 and reached is None and follower.status == GoalStatus.MOVING
    command, reached = follower.update(at(0.96))
    assert_array_equal(command, np.zeros(4))
    assert reached is target and follower.current is None
    # Pushed away, it does not start again.
    assert follower.update(at(0.5))[1] is None
    assert follower.status == GoalStatus.REACHED


@pytest.mark.parametrize(
    ('tolerance', 'place', 'status'),
    # The height of a waypoint is nothing to a ground robot.
    [(0.0, at(0.85), 'MOVING'), (0.2, at(0.85), 'REACHED'), (0.1, at(0.95, z=0.0), 'REACHED')],
)
def test_a_goal_may_bring_its_own_tolerance(tolerance, place, status):
    follower = follower_of()
    follower.adopt(goal(1.0, tolerance=tolerance))
    follower.update(place)
    assert follower.status.name == status


def test_a_flying_robot_holds_where_it_was_where_it_arrived_or_where_its_goal_is_cancelled():
    follower = follower_of('constant_speed')
    assert follower.target is None
    for place, held in ((0.0, 0.0), (0.4, 0.0)):
        command = follower.update(at(place))[0]
        assert (command[0] < -0.01) == (place > held)
    follower.adopt(goal(1.0))
    follower.update(at(0.2))
    assert_array_equal(follower.target, [1.0, 0.0, 1.0])
    follower.end(GoalStatus.CANCELED, 'cancelled')
    assert_allclose(follower.update(at(0.4))[0], np.zeros(4), atol=1e-12)
    assert follower.update(at(0.5))[0][0] < 0.0
    assert_array_equal(follower.target, [0.4, 0.0, 1.0])
    follower.adopt(goal(3.0))
    follower.update(at(2.97))
    assert follower.status == GoalStatus.REACHED and follower.update(at(2.8))[0][0] > 0.05
    # `let_go` lets a robot that has reached its waypoint hold that, `stay` does not.
    for tell, held in ((follower.let_go, 3.0), (follower.stay, 2.5)):
        tell()
        follower.update(at(2.5))
        assert_array_equal(follower.target, [held, 0.0, 1.0])
