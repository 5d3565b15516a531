"""The action `search`: states of its goal, clients that die, ends, and a new search."""

from action_msgs.msg import GoalStatus
from driven_team import driven

from maasi_msgs.action import SearchTargets
from maasi_msgs.msg import FilterUpdate

Result = SearchTargets.Result
# A client that sends a goal, says that it was accepted, and waits for ever.
CLIENT = """
import rclpy
from rclpy.action import ActionClient
from maasi_msgs.action import SearchTargets
rclpy.init()
node = rclpy.create_node('mortal')
client = ActionClient(node, SearchTargets, 'search')
client.wait_for_server()
future = client.send_goal_async(SearchTargets.Goal())
rclpy.spin_until_future_complete(node, future)
print('accepted' if future.result().accepted else 'refused', flush=True)
rclpy.spin(node)
"""


def find(world, number):
    """Publish an update of the filter that has found so many targets."""
    message = FilterUpdate(batch_id=world.planner.batches.last, found=number)
    message.header.frame_id = 'map'
    world.updates.publish(message)


def end_of(world, result, status):
    """Return the result of a search that has ended with a status."""
    world.until(result.done)
    assert result.result().status == status
    return result.result().result


def a_client_that_was_killed_does_not_block_the_next(world):
    client = world.run('-c', CLIENT)
    try:
        world.until(world.moving)
        assert 'accepted\n' in iter(client.stdout.readline, '')
    finally:
        client.kill()
        client.communicate()
    world.pass_steps(10)
    handle, result = world.ask()
    world.until(lambda: world.logged('search ended: replaced by another goal'))
    world.until(lambda: handle.status == GoalStatus.STATUS_EXECUTING)
    world.until(world.moving)
    # A living client learns that its goal was replaced.
    second, second_result = world.ask()
    end = end_of(world, result, GoalStatus.STATUS_ABORTED)
    assert end.message == 'replaced by another goal'
    world.until(lambda: second.status == GoalStatus.STATUS_EXECUTING)
    assert not second_result.done()
    second.cancel_goal_async()
    world.until(second_result.done)
    world.until(world.standing)


def a_goal_is_executing_and_ends_as_it_says(world):
    handle, result = world.ask(targets=12)
    world.until(world.moving)
    world.until(lambda: handle.status == GoalStatus.STATUS_EXECUTING)
    world.until(lambda: world.planner.batches.last > 0)
    find(world, 11)
    world.until(lambda: world.planner.batches.update.found == 11)
    world.pass_steps(5)
    assert not result.done() and handle.status == GoalStatus.STATUS_EXECUTING
    find(world, 12)
    end = end_of(world, result, GoalStatus.STATUS_SUCCEEDED)
    assert (end.end_reason, end.found) == (Result.TARGETS_FOUND, 12)
    world.until(world.standing)

    def nothing_left(_):
        world.planner.coordinator.exploration.values[...] = 0.0

    def deactivate(_):
        assert world.planner.trigger_deactivate().name == 'SUCCESS'

    succeeded, aborted = GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_ABORTED
    for act, limit, status, reason, message in (
        (nothing_left, 0.0, succeeded, Result.DONE, 'explored'),
        (lambda _: None, 1.0, succeeded, Result.TIME_LIMIT, '1 s'),
        (
            lambda goal: goal.cancel_goal_async(),
            0.0,
            GoalStatus.STATUS_CANCELED,
            Result.CANCELED,
            '',
        ),
        (lambda _: world.call('search/stop'), 0.0, aborted, Result.CANCELED, 'by search/stop'),
        (deactivate, 0.0, aborted, Result.CANCELED, 'planner'),
    ):
        handle, result = world.ask(time_limit=limit)
        world.until(lambda result=result: world.moving() or result.done())
        act(handle)
        end = end_of(world, result, status)
        assert end.end_reason == reason and message in end.message
        world.until(world.standing)


def test_goals_are_executing_until_they_are_replaced_or_end_as_they_say():
    with driven(search_on_start=False) as world:
        a_client_that_was_killed_does_not_block_the_next(world)
        a_goal_is_executing_and_ends_as_it_says(world)
