"""Nodes that play a run by a script: what they find, when they die. Started as processes by tests.

Usage: fake_nodes.py ROLE --ros-args ... with parameters `robots`, `lockstep`, `step`, `fault`
(none, die, hang, loop, raise, deaf, silent, mute), `fault_step`, `targets` (flat), `finished_step`,
`marker`.
"""

import os
import signal
import sys
import threading

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.qos import LATCHED_ALL as LATCHED
from maasi_filter.ros.qos import RELIABLE as ALL
from maasi_msgs.msg import (
    AgentState,
    BatchMember,
    DetectionArray,
    FilterUpdate,
    FoundTarget,
    FoundTargetArray,
    LockstepDone,
    LockstepStep,
    MeasurementBatch,
    PlanDecision,
    RobotDecision,
)


class Fake(Node):
    """What all have in common."""

    def __init__(self, role):
        super().__init__(role)
        self.robots = list(self.value('robots', ['mambo']))
        self.lockstep = self.value('lockstep', True)
        self.length = self.value('step', 0.05)
        self.fault = self.value('fault', 'none')
        self.fault_step = self.value('fault_step', 0)
        self.marker = self.value('marker', '')
        self.full_name = self.get_fully_qualified_name()
        self.diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_timer(1.0, self.beat)
        self.done = self.create_publisher(LockstepDone, '/lockstep/done', ALL)
        if role != 'sim_node':
            self.create_subscription(LockstepStep, '/lockstep/step', self.on_step, ALL)

    def value(self, name, default):
        return self.declare_parameter(name, default).value

    def beat(self):
        """Publish a sign of life, as all nodes do."""
        status = DiagnosticStatus(name=self.full_name)
        self.diagnostics.publish(DiagnosticArray(status=[status]))

    def say_ready(self, *peers):
        """Say so once each publisher has as many subscriptions as named, the recorder's apart."""
        self.peers = peers
        # Last: who hears it knows all others.
        self.ready = self.create_publisher(LockstepDone, '/lockstep/ready', LATCHED)
        if self.fault != 'silent':
            self.ready_timer = self.create_timer(0.01, self.look_for_peers)

    def look_for_peers(self):
        if all(self.is_heard(publisher, number) for publisher, number in self.peers):
            self.ready_timer.cancel()
            self.ready.publish(LockstepDone(node=self.full_name, step=0))

    def is_heard(self, publisher, number):
        known = self.get_subscriptions_info_by_topic(publisher.topic_name)
        return sum(
            info.node_name != 'recorder' for info in known
        ) >= number and publisher.get_subscription_count() >= len(known)

    def finish(self, step):
        self.done.publish(LockstepDone(node=self.full_name, step=step))

    def misbehave(self, step):
        """Do what the script says at this step; a restarted process behaves."""
        if self.fault == 'none' or step != self.fault_step:
            return False
        if self.marker and os.path.exists(self.marker):
            return False
        if self.marker:
            open(self.marker, 'w').close()
        if self.fault == 'die':
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fault == 'raise':
            raise RuntimeError('a scripted fault')
        while self.fault == 'loop':
            # The executor's thread is busy for ever; the process lives.
            pass
        return self.fault == 'hang'

    def stamp(self, step):
        return stamp_to_ros(round(step * self.length * 1e9))


class Sim(Fake):
    """The clock and the robots' odometry."""

    def __init__(self):
        super().__init__('sim_node')
        self.steps = self.create_publisher(LockstepStep, '/lockstep/step', ALL)
        self.clock = self.create_publisher(Clock, '/clock', 10)
        self.odometry = {
            name: self.create_publisher(Odometry, f'/{name}/odom', ALL) for name in self.robots
        }
        expected = ['/filter_node', '/planner_node', *(f'/{name}/driver' for name in self.robots)]
        self.missing = {*expected, '/recorder'}
        self.taking_part = set(self.missing)
        self.step = -1
        self.waiting = set()
        self.returned = set()
        self.create_subscription(LockstepDone, '/lockstep/ready', self.on_ready, LATCHED)
        self.create_subscription(LockstepDone, '/lockstep/done', self.on_done, ALL)
        self.create_timer(0.1 if self.lockstep else 0.02, self.look if self.lockstep else self.tick)
        self.say_ready()

    def on_ready(self, message):
        if message.node in self.waiting:
            self.returned.add(message.node)
        self.missing.discard(message.node)

    def look(self):
        """Begin once all that are ready are connected; repeat a step for who came back."""
        others = len(self.taking_part) - 1
        if self.step < 0 and not self.missing and self.is_heard(self.steps, others):
            self.advance()
        if self.returned and self.waiting:
            self.publish_step()

    def tick(self):
        if not self.missing:
            self.advance()

    def advance(self):
        self.step += 1
        if self.misbehave(self.step):
            return
        self.waiting = set(self.taking_part)
        self.returned.clear()
        self.publish_step()

    def publish_step(self):
        stamp = self.stamp(self.step)
        for publisher in self.odometry.values():
            odometry = Odometry()
            odometry.header.stamp = stamp
            publisher.publish(odometry)
        self.clock.publish(Clock(clock=stamp))
        self.steps.publish(LockstepStep(step=self.step, robots=self.robots, stamp=stamp))

    def on_done(self, message):
        if message.step == self.step and self.lockstep:
            self.waiting.discard(message.node)
            if not self.waiting:
                self.advance()


class Driver(Fake):
    """A robot that moves along x."""

    def __init__(self):
        super().__init__('driver')
        self.name = self.get_namespace().strip('/')
        self.state = self.create_publisher(AgentState, 'state', ALL)
        self.command = self.create_publisher(TwistStamped, 'cmd_vel', ALL)
        self.detections = self.create_publisher(DetectionArray, 'detections', ALL)
        self.create_subscription(MeasurementBatch, '/measurement_batch', self.on_batch, ALL)
        self.say_ready((self.detections, 1), (self.done, 1))

    def on_step(self, message):
        if self.misbehave(message.step):
            return
        state = AgentState(step=message.step, robot=self.name, goal_status=AgentState.MOVING)
        state.header.stamp = message.stamp
        state.pose.pose.position.x = 0.01 * message.step
        if self.fault != 'mute' or message.step > self.fault_step > 0:
            self.state.publish(state)
        command = TwistStamped()
        command.header.stamp = message.stamp
        command.twist.linear.x = 0.2
        self.command.publish(command)
        self.finish(message.step)

    def on_batch(self, batch):
        for member in batch.members:
            if member.robot == self.name:
                answer = DetectionArray(
                    batch_id=batch.id, step=batch.step, robot=self.name, measurement=batch.id
                )
                answer.header.stamp = batch.stamp
                self.detections.publish(answer)

    def stop(self):
        self.command.publish(TwistStamped())


class Filter(Fake):
    """Finds the next target of the list with each batch."""

    def __init__(self):
        super().__init__('filter_node')
        self.targets = list(self.value('targets', [0.0]))
        self.update = self.create_publisher(FilterUpdate, '/filter_update', ALL)
        self.found_targets = self.create_publisher(FoundTargetArray, '/found_targets', LATCHED)
        self.found = []
        self.pending = {}
        self.answered = set()
        self.create_subscription(MeasurementBatch, '/measurement_batch', self.on_batch, ALL)
        for name in self.robots:
            self.create_subscription(DetectionArray, f'/{name}/detections', self.on_detections, ALL)
        self.say_ready((self.update, 1), (self.done, 1))

    def on_step(self, message):
        if not self.misbehave(message.step):
            self.finish(message.step)

    def on_batch(self, batch):
        self.pending.setdefault(batch.id, [None, set()])[0] = batch
        self.process(batch.id)

    def on_detections(self, detections):
        self.pending.setdefault(detections.batch_id, [None, set()])[1].add(detections.robot)
        self.process(detections.batch_id)

    def process(self, number):
        batch, robots = self.pending[number]
        if batch is None or number in self.answered or len(robots) < len(batch.members):
            return
        self.answered.add(number)
        index = len(self.found)
        new = []
        if 2 * index < len(self.targets) - 1:
            target = FoundTarget(id=index + 1, robot=self.robots[0], batch_id=number)
            target.position.x, target.position.y = self.targets[2 * index : 2 * index + 2]
            target.stamp = batch.stamp
            new = [target]
            self.found += new
        array = FoundTargetArray(batch_id=number, targets=self.found)
        update = FilterUpdate(batch_id=number, step=batch.step, members=batch.members)
        update.found, update.newly_found = len(self.found), new
        for message in (array, update):
            message.header.stamp = batch.stamp
        self.found_targets.publish(array)
        self.update.publish(update)


class Planner(Fake):
    """Decides and measures every tenth step."""

    def __init__(self):
        super().__init__('planner_node')
        self.finished_step = self.value('finished_step', -1)
        self.decisions = self.create_publisher(PlanDecision, '/decisions', ALL)
        self.batch = self.create_publisher(MeasurementBatch, '/measurement_batch', ALL)
        self.create_subscription(FilterUpdate, '/filter_update', self.on_update, ALL)
        self.number = 0
        # Repeated until it is answered: a restarted robot may not be connected yet.
        self.asked = None
        self.create_timer(1.0, self.ask)
        self.say_ready((self.batch, 1 + len(self.robots)), (self.done, 1))

    def on_step(self, message):
        if self.misbehave(message.step):
            return
        if message.step % 10:
            self.finish(message.step)
            return
        finished = 0 <= self.finished_step <= message.step
        decision = PlanDecision(step=message.step, planner='maasi', explored=0.5)
        decision.header.stamp = message.stamp
        decision.reason = 'nothing is left to gain' if finished else ''
        for name in () if finished else self.robots:
            decision.robots.append(RobotDecision(robot=name, decision=self.number, chosen=0))
        self.decisions.publish(decision)
        self.number += 1
        batch = MeasurementBatch(id=self.number, step=message.step, stamp=message.stamp)
        for name in self.robots:
            member = BatchMember(robot=name, decision=self.number, measurement=self.number)
            batch.members.append(member)
        self.asked = batch
        self.ask()

    def ask(self):
        if self.asked is not None:
            self.batch.publish(self.asked)

    def on_update(self, update):
        self.asked = None
        self.finish(update.step)


def main():
    role = sys.argv[1]
    rclpy.init()
    node = {'sim': Sim, 'driver': Driver, 'filter': Filter, 'planner': Planner}[role]()
    if node.fault == 'deaf':
        # Ends by nothing but SIGKILL.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading.Thread(target=threading.Event().wait, daemon=False).start()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if role == 'driver' and rclpy.ok():
            node.stop()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
