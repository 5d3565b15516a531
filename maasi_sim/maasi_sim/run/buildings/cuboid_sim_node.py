"""The simulation node of searches of buildings: robots, time and radio link."""

from functools import partial
from typing import Any

from rclpy.publisher import Publisher
from std_msgs.msg import Header

from maasi_filter.ros.conversions import stamp_of_step, stamp_to_ros
from maasi_filter.ros.qos import RELIABLE
from maasi_msgs.msg import SearchLink, SearchLinkArray
from maasi_sim.run.buildings.mission import within_range
from maasi_sim.run.buildings.scenario import load_cuboid_scenario
from maasi_sim.run.buildings.simulation import CuboidSimulation
from maasi_sim.simulation.sim_node import SimNode

_PATIENCE = 0.1  # share of a step after which the link delivers, even if robots have not sent


class CuboidSimNode(SimNode):
    """Simulate the robots of a search of buildings and a radio of limited range.

    Each robot receives one message per step with all that the robots in its range have sent: once
    all present robots have sent or, without lockstep, soon after the step begins.

    Publishes
    ---------
    `<robot>/link/rx` (maasi_msgs/SearchLinkArray)

    Subscribes
    ----------
    `<robot>/link/tx` (maasi_msgs/SearchLink)
    """

    robot_node = 'cuboid_planner'
    load = staticmethod(load_cuboid_scenario)
    simulate = CuboidSimulation
    scenario: Any

    def connect(self) -> None:
        """See `SimNode.connect`."""
        self._sent: dict[str, SearchLink] = {}
        self._served: set[str] = set()
        self._link_publishers: dict[str, Publisher] = {}
        for name in self.simulation.robots:
            publisher = self.create_publisher(SearchLinkArray, f'{name}/link/rx', RELIABLE)
            self._link_publishers[name] = publisher
            self._expected[self._driver_of[name]].append(publisher.topic_name)
            on_sent = partial(self._on_sent, name)
            self.create_subscription(SearchLink, f'{name}/link/tx', on_sent, RELIABLE)
        self._link_timer = self.create_wall_timer(1.0, self._deliver)
        self._link_timer.cancel()

    def on_new_step(self) -> None:
        """See `SimNode.on_new_step`."""
        self._sent.clear()
        self._served.clear()
        if not self.settings.lockstep:
            self._link_timer.timer_period_ns = max(round(_PATIENCE * self._period * 1e9), 1)
            self._link_timer.reset()

    def _on_sent(self, name: str, message: SearchLink) -> None:
        if name in self.simulation.away:
            return
        if message.robot != name or int(message.step) != self.step:
            self.drop(
                'stale link',
                f'{name}/link/tx: read {message.robot!r}, step {message.step}, allowed is '
                f'{name!r}, step {self.step}',
            )
            return
        self._sent[name] = message
        # A restarted robot receives the messages of this step again.
        self._served.discard(name)
        if all(robot in self._sent for robot in self.simulation.present):
            self._deliver()

    def _deliver(self) -> None:
        self._link_timer.cancel()
        places = {
            name: self.simulation.robots[name].state.pose.position
            for name, message in self._sent.items()
            if not message.silent
        }
        in_range = within_range(places, self.scenario.planner.communication_range)
        stamp = stamp_to_ros(stamp_of_step(self.step, self.scenario.step))
        header = Header(frame_id=self.settings.frame, stamp=stamp)
        for name in self.simulation.present:
            if name in self._served or name not in self._sent:
                continue
            self._served.add(name)
            self._link_publishers[name].publish(
                SearchLinkArray(
                    header=header,
                    step=self.step,
                    messages=[self._sent[other] for other in in_range.get(name, [])],
                )
            )
