"""What the planner `tour` says of its decisions: reasons, and the rest of tours as it is flown."""

import re

import numpy as np
import pytest
import shapely
from planner_helpers import area_of, planning_robot
from std_msgs.msg import Header

from maasi_filter.models.detection import BoxDetection
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_filter.wording import point
from maasi_planner import TeamView, make_planner
from maasi_planner.conversions import decision_to_ros
from maasi_planner.planners.base import check_decision
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.recording import facts_for

CLEAR = 0.2  # radius of the robots [m]


def random_search(seed):
    """Return a team of two robots in an area with keep-outs of random places and sizes."""
    rng = np.random.default_rng(seed)
    zones = []
    for x, y in rng.uniform(6.0, 18.0, (3, 2)):
        dx, dy = rng.uniform(1.5, 6.0, 2)
        zones.append({'polygon': [[x, y], [x + dx, y], [x + dx, y + dy], [x, y + dy]]})
    area = area_of(26.0, 26.0, float(rng.uniform(2, 9)), keep_outs=zones)
    detection = BoxDetection([-1.5, -1.5], [1.5, 1.5], 0.8, 'world')
    robots = {
        name: planning_robot(start, detection, area, CLEAR, clearance=0.4)
        for name, start in (('east', (25.0, 1.0)), ('west', (1.0, 1.0)))
    }
    clusters = [Cluster(np.array([4.2, 20.3]), 0.01 * np.eye(2), 0.1, 0.7)] if seed % 2 else []
    return TeamView(0, 0.1, robots, clusters, UnexploredMap(area, 0.5)), area


@pytest.mark.parametrize('seed', range(6))
def test_the_rest_of_a_tour_leads_around_keep_outs(seed):
    team, area = random_search(seed)
    planner = make_planner('tour')
    decision = planner.decide(team)
    check_decision(planner, team, decision)
    closed = shapely.union_all(area.shapes['keep_out']).buffer(CLEAR)
    bent = 0
    for name, robot in decision.robots.items():
        drawn = shapely.LineString(np.vstack([robot.waypoint, robot.tour])[:, :2])
        assert drawn.intersection(closed).length < 1e-6
        bent += len(robot.tour) > len(planner.routes[name])
    assert bent


@pytest.mark.parametrize('name', ['tour', 'auto'])
@pytest.mark.parametrize('seed', range(6))
def test_each_waypoint_has_a_reason_with_numbers_also_in_nodes(name, seed):
    team, _ = random_search(seed)
    tour = make_planner(name, team=team)
    decision = tour.decide(team)
    if name == 'auto':
        decision.reason = f'tour: {decision.reason}'
    events = []
    made = decision_to_ros(decision, dict.fromkeys(decision.robots, 0), name, 0, 0.0, Header())
    maker = EventMaker({'robots': {}}, events.append)
    facts = facts_for(maker.scene, waits=False)
    for fact in facts.of('/decisions', 'maasi_msgs/msg/PlanDecision', made):
        maker.add(fact)
    (plan,) = [event for event in events if event[1] == 'plan']
    told = {row[0]: row[5] for row in plan[7]}
    assert told == {robot: item.reason for robot, item in decision.robots.items()}
    for robot, item in decision.robots.items():
        text = told[robot]
        place = re.match(r'next on its tour is \((.*?), (.*?)\) m, where it expects ', text)
        # Straight runs are one leg, whose end may be moved out of a zone.
        assert np.linalg.norm([float(word) for word in place.groups()] - item.waypoint[:2]) < 3.0
        first = tour.points[tour.routes[robot][0]]
        assert f'; then {point(first)} m' in text
        assert re.search(
            r'; the alternative \(.*\) m, .* m away, is (later|assigned to \w+)$', text
        )
