"""The action `search`: states of its goal, clients that die, ends, and a new search."""

import signal
import subprocess
import sys

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


def found(world, number):
    """Publish an update of the filter that has found so many targets."""
    message = FilterUpdate(batch_id=0, found=number)
    message.header.frame_id = 'map'
    message.batch_id = world.planner._batches.last
    message.members = []
    world.updates.publish(message)


def test_a_goal_is_executing_and_ends_as_it_says():
    with driven(search_on_start=False) as world:
        handle, result = world.ask(targets=12)
        world.until(world.moving)
        world.until(lambda: handle.status == GoalStatus.STATUS_EXECUTING)
        world.until(lambda: world.planner._batches.last > 0)
        found(world, 11)
        world.until(lambda: world.planner._batches.update.found == 11)
        world.pass_steps(5)
        assert not result.done() and handle.status == GoalStatus.STATUS_EXECUTING
        found(world, 12)
        world.until(result.done)
        assert result.result().status == GoalStatus.STATUS_SUCCEEDED
        assert result.result().result.end_reason == Result.TARGETS_FOUND
        assert result.result().result.found == 12
        world.until(world.standing)

        # Nothing left to gain: DONE; then a new search.
        handle, result = world.ask()
        world.until(world.moving)
        world.planner.coordinator.exploration.values[...] = 0.0
        world.until(result.done, 'not done')
        assert result.result().result.end_reason == Result.DONE
        assert result.result().status == GoalStatus.STATUS_SUCCEEDED
        world.until(world.standing)
        handle, result = world.ask()
        world.until(world.moving)
        assert not result.done()
        cancel = handle.cancel_goal_async()
        world.until(cancel.done)
        world.until(result.done)
        assert result.result().status == GoalStatus.STATUS_CANCELED
        assert result.result().result.end_reason == Result.CANCELED
        world.until(world.standing)

        handle, result = world.ask()
        world.until(world.moving)
        assert world.call('search/stop').success
        world.until(result.done)
        assert result.result().status == GoalStatus.STATUS_ABORTED
        assert result.result().result.message == 'stopped by search/stop'

        handle, result = world.ask()
        world.until(world.moving)
        assert world.planner.trigger_deactivate().name == 'SUCCESS'
        world.until(result.done)
        assert result.result().status == GoalStatus.STATUS_ABORTED
        assert result.result().result.message == 'the planner stops'
        world.until(world.standing)


def test_a_client_that_was_killed_does_not_block_the_next():
    with driven(search_on_start=False) as world:
        client = subprocess.Popen(
            [sys.executable, '-c', CLIENT],
            env={**world.environment, 'ROS_DOMAIN_ID': str(world.domain)},
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            world.until(world.moving)
            assert client.stdout.readline() == 'accepted\n'
        finally:
            client.send_signal(signal.SIGKILL)
            client.communicate()
        world.pass_steps(10)
        handle, result = world.ask()
        world.until(lambda: world.logged('search ended: replaced by another goal'))
        world.until(lambda: handle.status == GoalStatus.STATUS_EXECUTING)
        world.until(world.moving)
        # A living client learns that its goal was replaced.
        second, second_result = world.ask()
        world.until(result.done)
        assert result.result().status == GoalStatus.STATUS_ABORTED
        assert result.result().result.message == 'replaced by another goal'
        world.until(lambda: second.status == GoalStatus.STATUS_EXECUTING)
        assert not second_result.done()
