"""A node that shows any search, of real robots or a played bag."""

import argparse
import sys
from collections.abc import Callable
from functools import partial

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import HistoryPolicy
from rclpy.utilities import remove_ros_args

from maasi_filter.ros.qos import reader_of
from maasi_sim.run.bag import IMAGE_TYPE
from maasi_sim.run.message_facts import is_read
from maasi_sim.run.missions import load_mission
from maasi_sim.run.run_options import ViewOptions, add_view_options
from maasi_sim.run.topics import message_class
from maasi_sim.run.view.event_log import Scene
from maasi_sim.run.view.live_view import RunPage
from maasi_sim.run.view.scene import empty_scene, scene_of
from maasi_sim.scenario.layering import ScenarioError, print_warnings_plainly

DONE, WRONG_INPUT = 0, 2
_DISCOVERY = 0.5  # period of checks for new topics [s]


class ViewNode(Node):
    """Passes messages of shown topics to a function that never waits: topic, type, message.

    Subscribes
    ----------
    every topic of a type in `maasi_sim.run.message_facts.READERS`, with its publishers' QoS
    """

    def __init__(self, put: Callable[[str, str, bytes], None]) -> None:
        super().__init__('view_node')
        self._put = put
        self._known: set[str] = set()
        self.create_timer(_DISCOVERY, self._discover)
        self._discover()

    def _discover(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            # Raw images would load the network of real robots.
            unknown = topic not in self._known and types[0] != IMAGE_TYPE
            if not (unknown and is_read(topic, types[0])):
                continue
            offers = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
            if not offers:
                continue
            self._known.add(topic)
            qos = reader_of(offers)
            # A bounded history: publishers never wait for the page.
            qos.history = HistoryPolicy.KEEP_LAST
            self.create_subscription(
                message_class(types[0]), topic, partial(self._put, topic, types[0]), qos, raw=True
            )


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='view_node', description='Show a search in a browser, from its topics.'
    )
    parser.add_argument(
        '--scenario',
        metavar='FILE',
        help='scenario of the search; shows fields of view, obstacles and scores, too',
    )
    parser.add_argument(
        '--namespace', default='', metavar='NS', help='namespace of the team to control'
    )
    add_view_options(parser)
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the node until it is interrupted."""
    given = sys.argv[1:] if arguments is None else arguments
    options = build_parser().parse_args(remove_ros_args(['', *given])[1:])
    scene: Scene = empty_scene('live')
    print_warnings_plainly()
    if options.scenario:
        try:
            mission = load_mission(options.scenario)
        except ScenarioError as error:
            print(f'error: {error}', file=sys.stderr)
            return WRONG_INPUT
        scene = scene_of(mission.name, mission.scenario)
    rclpy.init(args=given)
    domain = rclpy.get_default_context().get_domain_id()
    try:
        served = ViewOptions(options.port, options.host, options.control)
        page = RunPage(scene, served, domain, options.namespace, waits=False)
    except OSError as error:
        print(f'error: {options.host}: {error.strerror or error}', file=sys.stderr)
        rclpy.try_shutdown()
        return WRONG_INPUT
    node = ViewNode(page.put_message)
    page.announce(partial(print, flush=True), options.browser)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        page.end()
        page.close()
        rclpy.try_shutdown()
    return DONE
