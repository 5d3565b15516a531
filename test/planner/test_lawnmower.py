"""The lawnmower with batteries: lanes that are out of reach are left out, and said."""

import re

import numpy as np
import pytest
from planner_helpers import area_of, follow, planning_robot

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.detection import BoxDetection
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import RobotState, TeamView, make_planner
from maasi_planner.endurance import Endurance, EnduranceSettings

BOX = BoxDetection([-1.0, -1.0], [1.0, 1.0], 1.0, 'world')


def team_of(starts, per_metre):
    """Return a team on 20 m x 8 m; per_metre: use of a full battery by robot [1/m], or None."""
    area, robots = area_of(20.0, 8.0), {}
    for number, (start, use) in enumerate(zip(starts, per_metre)):
        view = planning_robot(start, BOX, area)
        if use is not None:
            settings = EnduranceSettings(per_metre=use, reserve=0.1)
            view.endurance = Endurance(settings, view.motion, [*start, 0.0])
            view.endurance.update_charge(1.0)
        robots[f'robot{number}'] = view
    return TeamView(0, 0.1, robots, [], UnexploredMap(area, 0.25))


def mow(team, planner, most=100):
    """Send robots until the planner has finished, and charge those that ask; return the waypoints.

    As in a search, robots charge as far as possible before they ask again.
    """
    waypoints = {name: [] for name in team.robots}
    for _ in range(most):
        if planner.finished(team) is not None:
            return waypoints
        for name, robot in planner.decide(team).robots.items():
            view = team.robots[name]
            if not robot.stays:
                waypoints[name].append(robot.waypoint[:2])
                follow(team, name, robot)
                length = np.linalg.norm(np.diff(robot.positions, axis=0), axis=1).sum()
                if view.endurance is not None:
                    view.endurance.update_charge(view.endurance.charge - 0.1 * length * 0.01)
                    view.endurance.topped = False
            elif robot.unaffordable:
                view.state = RobotState.at_rest(view.endurance.chargers[0])
                view.endurance.update_charge(1.0)
                view.endurance.topped = True
    raise AssertionError('does not end')


def rows(waypoints):
    return sorted({round(float(place[1]), 3) for place in waypoints})


def test_lanes_that_nobody_affords_are_left_out_and_said():
    # 0.9 of a battery is 30 m: lanes of 18 m at up to 5 m are there and back.
    team, planner = team_of([(1.0, 1.0)], [0.03]), make_planner('lawnmower')
    mow(team, planner)
    assert re.search(r'complete but \d', planner.finished(team))


def test_a_search_without_any_affordable_lane_ends():
    team, planner = team_of([(1.0, 1.0), (19.0, 7.0)], [2.0, 2.0]), make_planner('lawnmower')
    waypoints = mow(team, planner)
    assert not any(map(len, waypoints.values()))
    reason = planner.finished(team)
    assert 'complete but 4,' in reason
    assert '0.0 % of the environment is explored' in reason


@pytest.mark.parametrize('use', [2.0, 0.03])
def test_lanes_that_one_robot_cannot_afford_are_left_to_another(use):
    team, planner = team_of([(1.0, 1.0), (19.0, 7.0)], [use, None]), make_planner('lawnmower')
    waypoints = mow(team, planner)
    assert planner.finished(team).endswith('complete')
    assert len(rows([*waypoints['robot0'], *waypoints['robot1']])) == 4
    assert len(rows(waypoints['robot1'])) >= (4 if use == 2.0 else 2)


def test_a_robot_that_is_not_full_charges_before_it_gives_up_a_lane():
    team, planner = team_of([(1.0, 1.0)], [0.02]), make_planner('lawnmower')
    team.robots['robot0'].endurance.update_charge(0.2)
    chosen = planner.decide(team).robots['robot0']
    assert chosen.stays and chosen.unaffordable and planner.finished(team) is None
    team.robots['robot0'].endurance.update_charge(1.0)
    assert not planner.decide(team).robots['robot0'].stays


def test_lanes_below_a_zone_are_done_once_it_is_opened():
    team, planner = team_of([(1.0, 1.0)], [None]), make_planner('lawnmower')
    open_area, view = team.area, team.robots['robot0']
    zone = {'polygon': [[8.0, 3.5], [14.0, 3.5], [14.0, 8.5], [8.0, 8.5]]}
    values = {'bounds': [[0.0, 20.0], [0.0, 8.0]], 'keep_outs': [zone]}
    planner.decide(team)
    for area in (Area(EnvironmentSettings.model_validate(values)), open_area):
        team.exploration.adopt_area(area)
        view.motion.adopt_area(area, view.radius)
        assert planner.finished(team) is None
        mow(team, planner)
        if area is not open_area:
            assert team.exploration.closed_share() > 0.1
    assert team.exploration.explored_fraction() > 0.97
