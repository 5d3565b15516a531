"""Plays what is around a node under test, over real topics."""

import gc

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from waiting import wait_until

from maasi_filter.ros.parameters import flatten
from maasi_filter.ros.qos import RELIABLE
from maasi_filter.ros.run_node import executor_of


def parameters(settings):
    return [Parameter(name, value=value) for name, value in flatten(settings).items()]


class Player:
    """A node that plays (`node`) and the one that is tested (`tested`), with their executors."""

    def __init__(self, context, name):
        self.context = context
        self.node = Node(name, context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.tested = self.own = None

    def start(self, kind, settings, **options):
        options = {'context': self.context, 'parameter_overrides': parameters(settings)} | options
        self.tested = kind(**options)
        self.own = executor_of(self.tested, self.context)
        assert self.tested.trigger_configure().name == 'SUCCESS', self.tested.problem
        assert self.tested.trigger_activate().name == 'SUCCESS'
        return self.tested

    def end(self):
        self.tested.destroy_node()
        self.own.shutdown()
        self.tested = self.own = None
        gc.collect()  # see `own_context`

    def close(self):
        if self.tested is not None:
            self.end()
        self.executor.shutdown()
        self.node.destroy_node()

    def turn(self):
        if self.own is not None:
            self.own.spin_once(0.002)
        self.executor.spin_once(timeout_sec=0.002)

    def until(self, condition, *what):
        wait_until(condition, self.turn, *what)

    def collect(self, kind, topic, quality=RELIABLE):
        """Return the list that receives the messages of a topic."""
        received = []
        self.node.create_subscription(kind, topic, received.append, quality)
        return received

    def call(self, service):
        client = self.node.create_client(Trigger, service)
        self.until(client.service_is_ready, f'no service {service}')
        future = client.call_async(Trigger.Request())
        self.until(future.done, f'no answer of {service}')
        self.node.destroy_client(client)
        return future.result()
