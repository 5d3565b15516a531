"""RViz's files: each topic is there, and its quality of service fits the publisher's."""

import numpy as np
import pytest
import yaml
from node_kinds import KINDS
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from maasi_filter.ros.conversions import MarkerBoard
from maasi_planner.conversions import planner_markers
from maasi_sim.run.missions import load_mission
from maasi_sim.run.rviz_view import view_text


def topics_of(text):
    displays = yaml.safe_load(text)['Visualization Manager']['Displays']
    return {item['Topic']['Value']: item['Topic'] for item in displays if 'Topic' in item}


@pytest.mark.parametrize(
    ('scenario', 'kinds'),
    [
        ('mambo_turtlebot', ('filter', 'planner', 'sim')),
        ('buildings_one', ('cuboid_planner', 'cuboid_sim')),
    ],
)
def test_every_display_fits_its_publisher(context, scenario, kinds):
    displays = topics_of(view_text(load_mission(scenario)))
    nodes = [KINDS[kind].make(context) for kind in kinds]
    assert all(node.trigger_configure().name == 'SUCCESS' for node in nodes)
    shown = 0
    for topic, wanted in displays.items():
        for info in [i for node in nodes for i in publishers(node, topic)]:
            shown += 1
            offered = info.qos_profile
            latched = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert latched or wanted['Durability Policy'] == 'Volatile', topic
            reliable = offered.reliability == ReliabilityPolicy.RELIABLE
            assert reliable or wanted['Reliability Policy'] == 'Best Effort', topic
    # Of buildings there is neither filter nor exploration.
    missing = [t for t in displays if not any(publishers(node, t) for node in nodes)]
    allowed = ['compressed'] if scenario == 'mambo_turtlebot' else ['particles', 'truth']
    assert all(any(word in topic for word in allowed) for topic in missing), missing
    assert shown >= 2
    for node in nodes:
        node.destroy_node()


def publishers(node, topic):
    own = node.get_name()
    return [item for item in node.get_publishers_info_by_topic(topic) if item.node_name == own]


def test_a_tour_is_a_line_from_the_waypoint_through_the_places_that_follow():
    place, way = np.zeros(3), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 2.0]])
    tours = {'a': np.array([[1.0, 3.0, 2.0], [4.0, 3.0, 2.0]]), 'b': np.zeros((0, 3))}
    shown = {name: (place, way[-1], way, tour) for name, tour in tours.items()}
    markers = planner_markers(shown, dict.fromkeys(tours, '#0072B2'), Header(), 1.0).markers
    full, empty = (marker for marker in markers if marker.ns == 'tours')
    points = [[point.x, point.y, point.z] for point in full.points]
    assert points == [[1.0, 0.0, 2.0], *tours['a'].tolist()] and full.action == Marker.ADD
    assert empty.action == Marker.DELETE


def test_the_first_markers_clear_and_later_ones_replace_those_before():
    board = MarkerBoard()
    add, delete = Marker.ADD, Marker.DELETE
    for names, expected in (
        ('ab', [(Marker.DELETEALL, ''), (add, 'a'), (add, 'b')]),
        ('bc', [(delete, 'a'), (add, 'b'), (add, 'c')]),
    ):
        markers = [Marker(ns=name, type=Marker.SPHERE) for name in names]
        made = board.replace(MarkerArray(markers=markers)).markers
        assert [(item.action, item.ns) for item in made] == expected
