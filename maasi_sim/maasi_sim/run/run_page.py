"""The page of a running scenario."""

from __future__ import annotations

from typing import Any

from maasi_sim.run.bag import load_types
from maasi_sim.run.mission import Mission
from maasi_sim.run.run_options import ViewOptions
from maasi_sim.view.live_view import LiveView, MessageFeed
from maasi_sim.view.scene import scene_of


class RunPage:
    """Serves the page of a run, with the messages of its recorder.

    Parameters
    ----------
    mission : Mission
        What is run.
    options : ViewOptions
        Where it is served.
    domain : int
        ROS domain of the run.
    namespace : str
        Of its nodes.

    Raises
    ------
    OSError
        If the port cannot be listened on.
    """

    def __init__(
        self, mission: Mission[Any], options: ViewOptions, domain: int, namespace: str
    ) -> None:
        self._control = None
        if options.control:
            # rclpy starts threads when it is imported.
            from maasi_sim.view.control_node import Control

            self._control = Control(domain, namespace)
        scene = scene_of(mission.name, mission.scenario)
        self.view = LiveView(scene, options.port, options.host, self._control)
        self._feed = MessageFeed(self.view, load_types())

    def put(self, topic: str, type_name: str, data: bytes) -> None:
        """Queue a message; never blocks."""
        self._feed.put(topic, type_name, data)

    def close(self) -> None:
        """Show the queued messages, and stop serving."""
        self._feed.close()
        self.view.maker.end()
        self.view.end('the run has ended')
        if self._control is not None:
            self._control.close()
