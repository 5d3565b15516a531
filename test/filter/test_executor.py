"""The executor of a node: nothing that comes is left lying, and an error ends the node."""

import pytest
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32
from std_srvs.srv import Trigger
from waiting import wait_until

from maasi_filter.ros import readiness
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.node_settings import NodeSettings
from maasi_filter.ros.qos import RELIABLE
from maasi_filter.ros.run_node import executor_of


class Pair:
    """A node that listens, and one that talks to it."""

    def __init__(self, context):
        self.listener = Node('listener', context=context)
        self.talker = Node('talker', context=context)
        self.executor = executor_of(self.listener, context)
        self.answers = executor_of(self.talker, context)

    def until(self, condition, turn=lambda: None):
        """Let both spin; what the talker waits for must be there, not be waited for."""

        def spin():
            turn()
            self.executor.spin_once(0.05)
            self.answers.spin_once(0.0)

        wait_until(condition, spin)


@pytest.fixture
def pair(context):
    made = Pair(context)
    yield made
    made.executor.shutdown()
    made.answers.shutdown()
    made.listener.destroy_node()
    made.talker.destroy_node()


def test_timers_and_services_are_not_starved_by_messages(pair):
    ticks, heard = [], []
    pair.listener.create_subscription(Int32, 'step', heard.append, RELIABLE)
    publisher = pair.talker.create_publisher(Int32, 'step', RELIABLE)
    pair.listener.create_timer(0.01, lambda: ticks.append(len(heard)))
    pair.listener.create_service(Trigger, 'ask', lambda request, response: response)
    client = pair.talker.create_client(Trigger, 'ask')
    pair.until(lambda: client.service_is_ready() and publisher.get_subscription_count())
    future = client.call_async(Trigger.Request())
    pair.until(lambda: future.done() and len(ticks) >= 3, lambda: publisher.publish(Int32()))
    assert heard


@pytest.mark.parametrize('where', ['callback', 'task'])
def test_an_error_ends_the_spin(pair, where):
    def fail(message=None):
        raise RuntimeError(f'a {where} failed')

    if where == 'task':
        pair.executor.create_task(fail)
    else:
        pair.listener.create_subscription(Int32, 'bad', fail, RELIABLE)
        bad = pair.talker.create_publisher(Int32, 'bad', RELIABLE)
        pair.until(bad.get_subscription_count)
        bad.publish(Int32(data=3))
    with pytest.raises(RuntimeError, match=f'a {where} failed'):
        pair.until(lambda: False)


def test_the_end_of_the_context_ends_the_spin(pair):
    pair.listener.context.try_shutdown()
    with pytest.raises(ExternalShutdownException):
        pair.executor.spin_once(0.05)


def test_an_endpoint_that_does_not_fit_is_named(pair, monkeypatch):
    monkeypatch.setattr(readiness, '_CONNECTION_PATIENCE', 0.5)
    node = LockstepLifecycleNode('searcher', NodeSettings, context=pair.talker.context)
    node.create_publisher(Int32, 'found', 10)
    node.create_subscription(Int32, 'seen', print, RELIABLE)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    assert node.check_peers() == []
    odd = pair.talker.create_subscription(Int32, 'found', print, latched)
    hurried = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    pair.talker.create_publisher(Int32, 'seen', hurried)
    expected = [
        '/found: a subscription does not connect: its quality of service or type differs',
        '/seen: a publisher does not connect: its quality of service or type differs',
    ]
    wait_until(lambda: node.check_peers() == expected)
    pair.talker.destroy_subscription(odd)
    wait_until(lambda: node.check_peers() == expected[1:])
    node.destroy_node()
