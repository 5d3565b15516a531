"""Messages of the search of buildings."""

import numpy as np
import pytest
from cuboid_instances import AREA, robots_at, two_buildings
from std_msgs.msg import Header

from maasi_planner.buildings.agent import SearchAgent
from maasi_planner.buildings.conversions import (
    agent_markers,
    broadcast_from_ros,
    broadcast_to_ros,
    decision_to_ros,
    mission_markers,
)
from maasi_planner.buildings.preplanning import plan_mission

HEADER = Header(frame_id='map')


@pytest.fixture
def agent():
    settings = two_buildings()
    robot = robots_at({'red': [185, 235, 5]}, alpha=100.0)['red']
    made = SearchAgent('red', settings, plan_mission(settings, AREA), robot)
    made.observe(0, made.mission.centres[3], np.zeros(3))
    made.decide([], np.random.default_rng(0))
    return made


def test_a_broadcast_is_read_back(agent):
    sent = agent.observe(1, agent.mission.centres[3], [1.0, 2.0, -3.0])
    read = broadcast_from_ros(broadcast_to_ros(sent, HEADER), 32)
    assert len(read.plan) > 0 and read.visited.sum() == 1
    for name, value in vars(sent).items():
        assert np.all(getattr(read, name) == value), name


@pytest.mark.parametrize(
    ('field', 'value', 'words'),
    [
        ('visited', [True], 'visited: read 1 cuboids, allowed are 32'),
        ('planned', [40, 2], 'planned: read 40|planned_in'),
        ('planned_in', [1] * 31, 'planned_in: read 31'),
        ('alpha', float('nan'), 'finite'),
        ('beta', 0.0, 'above 0'),
    ],
)
def test_a_wrong_broadcast_is_refused(agent, field, value, words):
    message = broadcast_to_ros(agent.observe(1, agent.mission.centres[3], np.zeros(3)), HEADER)
    setattr(message, field, value)
    with pytest.raises(ValueError, match=words):
        broadcast_from_ros(message, 32)


def test_a_decision_has_its_snapshots_and_markers(agent):
    agent.observe(1, agent.mission.centres[4], np.zeros(3))
    plan = agent.decide([], np.random.default_rng(1))
    message = decision_to_ros(agent, plan, agent.snapshots[1:], HEADER)
    assert (message.step, message.visited, message.how) == (1, 2, 'optimal')
    assert [shot.cuboid for shot in message.snapshots] == [4]
    assert message.snapshots[0].detection_probability == pytest.approx(0.88)
    assert list(zip(message.planned_in, message.planned)) == plan.visits
    markers = agent_markers(agent, plan, HEADER).markers
    keys = [(marker.ns, marker.id) for marker in markers]
    assert len(keys) == len(set(keys)) == 32 + 3
    visited = [m.color.r for m in markers if m.ns == 'red/cuboids' and m.id in (3, 4)]
    assert len(set(visited)) == 1
    assert visited[0] != markers[0].color.r
    assert len(mission_markers(agent.mission, Header()).markers) == 2
