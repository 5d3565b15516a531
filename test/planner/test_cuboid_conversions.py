"""Messages of the search of buildings."""

import numpy as np
import pytest
from cuboid_instances import AREA, two_buildings
from std_msgs.msg import Header

from maasi_planner.buildings import (
    Dynamics,
    HazardSettings,
    SearchAgent,
    plan_mission,
)
from maasi_planner.buildings.conversions import (
    agent_markers,
    broadcast_from_ros,
    broadcast_to_ros,
    choice_to_ros,
    mission_markers,
)


@pytest.fixture
def agent():
    settings = two_buildings(time_limit=1e9)
    made = SearchAgent(
        'red', settings, plan_mission(settings, AREA), Dynamics(), HazardSettings(), [185, 235, 5]
    )
    made.observe(0, made.mission.centres[3], np.zeros(3))
    made.decide([], np.random.default_rng(0))
    return made


def test_a_broadcast_is_read_back(agent):
    sent = agent.observe(1, agent.mission.centres[3], [1.0, 2.0, -3.0])
    read = broadcast_from_ros(broadcast_to_ros(sent, Header(frame_id='map')), 32)
    assert (read.robot, read.step, read.searching) == ('red', 1, True)
    assert (read.flight_steps, read.hazard) == (sent.flight_steps, sent.hazard)
    assert read.plan == sent.plan and len(read.plan) > 0
    assert (read.visited == sent.visited).all() and read.visited.sum() == 1
    assert (read.position == sent.position).all() and (read.velocity == [1.0, 2.0, -3.0]).all()


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
    message = broadcast_to_ros(
        agent.observe(1, agent.mission.centres[3], np.zeros(3)), Header(frame_id='map')
    )
    setattr(message, field, value)
    with pytest.raises(ValueError, match=words):
        broadcast_from_ros(message, 32)


def test_a_decision_has_its_snapshots_and_markers(agent):
    agent.observe(1, agent.mission.centres[4], np.zeros(3))
    choice = agent.decide([], np.random.default_rng(1))
    shots = agent.snapshots[1:]
    message = choice_to_ros(agent, choice, shots, ['blue'], 0.002, Header(frame_id='map'))
    assert (message.step, message.visited, message.how) == (1, 2, 'optimal')
    assert [shot.cuboid for shot in message.snapshots] == [4]
    assert message.snapshots[0].detection_probability == pytest.approx(0.88)
    assert list(zip(message.planned_in, message.planned)) == choice.plan.visits
    markers = agent_markers(agent, choice, Header(frame_id='map')).markers
    keys = [(marker.ns, marker.id) for marker in markers]
    assert len(keys) == len(set(keys)) == 32 + 3
    visited = [m.color.r for m in markers if m.ns == 'red/cuboids' and m.id in (3, 4)]
    assert len(set(visited)) == 1
    assert visited[0] != markers[0].color.r
    assert len(mission_markers(agent.mission, Header()).markers) == 2
