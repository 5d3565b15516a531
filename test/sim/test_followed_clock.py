"""A simulation whose time is the clock of another run."""

import pytest
from rosgraph_msgs.msg import Clock
from test_sim_node import STEP, make_team, seconds, steps_of

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.qos import RELIABLE
from maasi_sim.sim_node import SimNode

__all__ = ['make_team']

SECOND = 1_000_000_000


@pytest.fixture
def team(make_team):
    return make_team(lockstep=False, rate=1.0, follow_clock=True, use_sim_time=True)


def test_robots_stand_until_all_are_ready_and_go_with_the_clock(team):
    clock = team.filter.create_publisher(Clock, '/clock', RELIABLE)
    driver = team.drivers['mambo']

    def reached(nanoseconds):
        # Best effort: said until it is heard.
        clock.publish(Clock(clock=stamp_to_ros(nanoseconds)))
        return team.filter.steps and seconds(team.filter.steps[-1].stamp) >= nanoseconds * 1e-9

    team.spin_until(lambda: '/clock' not in team.sim.status()['waits for'] or reached(7 * SECOND))
    assert not driver.of('odom') and not team.filter.steps
    team.say_ready()
    # Between two steps: the last one counts.
    team.spin_until(lambda: reached(7 * SECOND + SECOND // 100) or team.filter.steps)
    assert team.filter.steps[0].step == round(7.0 / STEP)
    team.spin_until(lambda: reached(8 * SECOND))
    steps = [message.step for message in team.filter.steps]
    assert steps == list(range(round(7.0 / STEP), round(8.0 / STEP) + 1))
    assert [round(seconds(item.stamp) / STEP) for item in team.filter.steps] == steps
    team.spin_until(lambda: len(driver.of('odom')) == len(steps))
    assert steps_of(driver.of('odom')) == steps
    # Its clock is not its own, and a time that comes again does not move anything.
    assert team.sim.count_publishers('/clock') == 1
    for _ in range(20):
        clock.publish(Clock(clock=stamp_to_ros(SECOND)))
        team.settle(0.01)
    assert [message.step for message in team.filter.steps] == steps
    team.spin_until(lambda: reached(8 * SECOND + SECOND // 10))
    assert team.filter.steps[len(steps)].step == steps[-1] + 1


def test_no_clock_is_said(team):
    team.say_ready()
    team.spin_until(lambda: team.sim.status()['waits for'] == '/clock')
    assert not team.filter.steps


def test_there_is_no_following_in_lockstep(context, tmp_path):
    from rclpy.parameter import Parameter

    node = SimNode(
        context=context,
        parameter_overrides=[
            Parameter('scenario', value='mambo'),
            Parameter('lockstep', value=True),
            Parameter('follow_clock', value=True),
        ],
    )
    assert node.trigger_configure().name == 'FAILURE'
    assert 'follow_clock: read true, allowed is false in lockstep' in node.problem
    node.destroy_node()
