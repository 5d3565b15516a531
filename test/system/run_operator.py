"""A node beside a run: it calls services, and hears topics."""

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from scenario_runs import PATIENCE
from std_srvs.srv import Trigger
from waiting import wait_until


class Operator:
    """A node in the domain of a run."""

    def __init__(self, domain):
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain.number)
        self.node = rclpy.create_node('operator', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def call(self, service):
        """Call a service until it does what it is to."""
        client = self.node.create_client(Trigger, service)
        while True:
            self.until(client.service_is_ready, service)
            answer = client.call_async(Trigger.Request())
            self.until(answer.done, service)
            if answer.result().success:
                return

    def until(self, condition, what):
        wait_until(condition, lambda: self.executor.spin_once(timeout_sec=0.02), what, PATIENCE)

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
