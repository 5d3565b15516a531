"""The stop of one robot: it works without a planner, and holds until it is released."""

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from numpy.testing import assert_array_equal

from maasi_drivers.agent.agent_driver import STOPPED
from maasi_msgs.msg import AgentState


@pytest.mark.parametrize('kind', ['turtlebot', 'mambo'])
def test_a_stopped_robot_stands_and_refuses_goals_until_it_is_released(play, kind):
    driver, team = play(kind)
    team.move()
    goal = team.start.position + np.array([0.8, 0.5, 0.0])
    _, result = team.send_accepted(goal)
    team.move(20)
    assert np.any(team.command[:3] != 0.0)
    known = len(team.commands)
    assert team.call('stop').success
    team.until(result.done)
    assert result.result().status == GoalStatus.STATUS_ABORTED
    assert result.result().result.reason == STOPPED
    # At once, not with the next odometry.
    team.until(lambda: len(team.commands) > known)
    assert_array_equal(team.command, np.zeros(4))
    place = team.body.robot_state().pose.position
    team.move(40)
    assert team.state.goal_status == AgentState.UNAVAILABLE and team.state.reason == STOPPED
    # A flying robot brakes, and is kept where it was told to stop.
    assert np.linalg.norm(team.body.robot_state().pose.position - place) < 0.15
    assert STOPPED in team.refused(goal)
    # Nobody releases it by restarting the node's life cycle.
    for transition in ('deactivate', 'cleanup', 'configure', 'activate'):
        assert getattr(driver, f'trigger_{transition}')().name == 'SUCCESS'
    team.connect()
    team.awaken()
    assert STOPPED in team.refused(goal)
    assert team.call('release').success
    team.until(lambda: team.move() or team.state.goal_status != AgentState.UNAVAILABLE)
    assert team.takes(goal, live=team.move)
