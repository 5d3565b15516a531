"""Free running: goals that other clients send to a robot, and what the planner makes of them."""

from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticStatus
from driven_team import driven

from maasi_msgs.msg import AgentState

FOREIGN = 7_000


def test_a_goal_of_another_client_is_respected_and_the_robot_is_taken_back_after_it():
    with driven() as world:
        a, b = world.robots.values()
        world.until(world.moving)
        # One that is refused changes nothing.
        _, result = world.send('a', (50.0, 0.5), FOREIGN - 1)
        world.until(result.done)
        assert result.result().status == GoalStatus.STATUS_ABORTED
        assert 'waypoint.pose.position.x' in result.result().result.reason
        world.pass_steps(5)
        assert a.state.goal_id < FOREIGN - 1
        assert not world.logged('of another client')

        _, result = world.send('a', (1.9, 0.1), FOREIGN)
        world.until(lambda: a.state.goal_id == FOREIGN)
        seen, decisions = len(a.states), len(world.decisions)
        world.listen(lambda: world.logged(f'a follows goal {FOREIGN} of another client'))
        world.listen(lambda: world.status.get('goals of other clients') == f'a (goal {FOREIGN})')
        assert world.status['level'] == DiagnosticStatus.WARN
        assert f'a follows goal {FOREIGN}' in world.status['message']
        world.until(lambda: result.done() and a.state.goal_id != FOREIGN)
        assert result.result().status == GoalStatus.STATUS_SUCCEEDED
        # The planner did not send it anywhere meanwhile, and the other robot went on.
        goals = [state.goal_id for state in a.states[seen:]]
        assert FOREIGN not in goals[goals.count(FOREIGN) :]
        robots = [robot for item in world.decisions[decisions:] for robot in item.robots]
        assert b.moves or 'b' in [robot.robot for robot in robots]
        world.until(lambda: a.state.goal_id not in (0, FOREIGN) and a.moves)
        world.until(lambda: world.status.get('goals of other clients') == '')
        assert world.status['level'] == DiagnosticStatus.OK
        assert len(world.logged('of another client')) == 1

        # Also where the other client has the planner's own number, and cancels its goal.
        same = a.state.goal_id
        handle, result = world.send('a', (0.1, 1.9), same)
        world.listen(lambda: world.status.get('goals of other clients') == f'a (goal {same})')
        handle.cancel_goal_async()
        world.until(result.done)
        assert result.result().status == GoalStatus.STATUS_CANCELED
        world.until(lambda: a.state.goal_id not in (0, same) and a.moves)


def test_a_planner_that_starts_again_waits_for_the_last_goal_of_the_one_before():
    with driven() as world:
        a = world.robots['a']
        world.until(world.moving)
        _, result = world.send('a', (1.9, 0.1), FOREIGN)
        world.until(lambda: a.state.goal_id == FOREIGN)
        world.end_planner()
        world.start_planner()
        world.until(lambda: world.planner.orders.external_goals.get('a') == FOREIGN)
        world.until(result.done)
        assert result.result().status == GoalStatus.STATUS_SUCCEEDED
        world.until(lambda: a.state.goal_id not in (0, FOREIGN) and a.moves)
        assert a.state.goal_status == AgentState.MOVING
