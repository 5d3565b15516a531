"""The clever objective against the plain one, and the joint search against enumeration."""

from __future__ import annotations

import numpy as np
import pytest
from plain_objective import all_choices, plain_information_terms, plain_terms
from planner_helpers import random_team

from maasi_filter.models.detection import BoxDetection
from maasi_planner import PlannerSettings, make_planner
from maasi_planner.objective.team_objective import TeamObjective
from maasi_planner.planners.base import free_of_robots, waiting_places
from maasi_planner.team import UsableCandidates


def built(team, settings):
    """Return the objective of a team with all its candidates, and its parts."""
    candidates = {name: team.robots[name].candidates for name in team.planning()}
    trajectories = {
        name: team.robots[name].motion.predict(
            team.robots[name].state, candidates[name], team.step_time
        )
        for name in candidates
    }
    places = waiting_places(team)
    allowed = {
        name: free_of_robots(candidates[name], team.robots[name].radius, places)
        & trajectories[name].reached
        & (trajectories[name].lengths > 0)
        for name in candidates
    }
    options = {
        name: UsableCandidates(points, trajectories[name], allowed[name])
        for name, points in candidates.items()
    }
    objective = TeamObjective(team, settings, options)
    return objective, candidates, trajectories, allowed


def indices(objective, choice):
    return np.array(
        [objective.start[i] + choice[name] for i, name in enumerate(objective.names)], np.int64
    )


CASES = [
    {'dimension': 2, 'planning': 1, 'waiting': 0},
    {'dimension': 2, 'planning': 2, 'waiting': 1},
    {'dimension': 2, 'planning': 3, 'waiting': 0},
    {'dimension': 3, 'planning': 1, 'waiting': 1},
    {'dimension': 3, 'planning': 2, 'waiting': 1},
]
PAPER = [
    {},
    {'extension': 'silent'},
    {'measure_at_arrival': True},
    {'count_present': False},
    {'normalisation': 'distance'},
]


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize('change', PAPER)
def test_paper_equals_plain_grid(case, change):
    settings = PlannerSettings(objective='paper', alpha=0.7, beta=0.4, **change)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        team = random_team(rng, candidates=4, **case)
        objective, candidates, trajectories, _ = built(team, settings)
        choices = list(all_choices(candidates))
        for number in rng.permutation(len(choices))[:6]:
            choice = choices[number]
            plain = plain_terms(team, settings, trajectories, choice)
            chosen = indices(objective, choice)
            total = 0.0
            for i, name in enumerate(objective.names):
                terms = objective.given(i, chosen)[choice[name]]
                assert terms[0] == pytest.approx(plain[name][1], rel=1e-9, abs=1e-12)
                assert terms[1] == pytest.approx(plain[name][2], rel=1e-9, abs=1e-12)
                total += plain[name][3]
            assert objective.value(chosen) == pytest.approx(total, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize('present', [True, False])
def test_information_equals_plain(case, present):
    settings = PlannerSettings(
        objective='information', exploration_nodes=1_000_000, count_present=present
    )
    for seed in range(3):
        rng = np.random.default_rng(100 + seed)
        team = random_team(rng, candidates=3, **case)
        objective, candidates, trajectories, _ = built(team, settings)
        choices = list(all_choices(candidates))
        for number in rng.permutation(len(choices))[:5]:
            choice = choices[number]
            plain = plain_information_terms(team, settings, trajectories, choice)
            chosen = indices(objective, choice)
            for i, name in enumerate(objective.names):
                terms = objective.given(i, chosen)[choice[name]]
                assert terms[0] == pytest.approx(plain[name][1], rel=1e-9, abs=1e-10)
                assert terms[1] == pytest.approx(plain[name][2], rel=1e-9, abs=1e-10)


@pytest.mark.parametrize('kind', ['paper', 'information'])
@pytest.mark.parametrize('case', [*CASES, {'dimension': 2, 'planning': 2, 'waiting': 2}])
def test_search_is_enumeration(case, kind):
    """The pruned search returns the maximum over all joint candidates (26)."""
    settings = PlannerSettings(objective=kind)
    for seed in range(4):
        rng = np.random.default_rng(1000 + seed)
        team = random_team(rng, candidates=6, radius=0.05, **case)
        objective, candidates, _, allowed = built(team, settings)
        best = -np.inf
        for choice in all_choices(candidates):
            if not all(allowed[name][w] for name, w in choice.items()):
                continue
            chosen = indices(objective, choice)
            places = [candidates[name][w] for name, w in choice.items()]
            radii = [team.robots[name].radius for name in choice]
            if any(
                np.linalg.norm(places[i] - places[j]) < radii[i] + radii[j]
                for i in range(len(places))
                for j in range(i)
            ):
                continue
            best = max(best, objective.value(chosen))
        chosen, value, exact, _ = objective.search()
        assert exact
        assert value == pytest.approx(best, rel=1e-12)
        assert objective.value(chosen) == value


def test_bound_prunes():
    """Two robots far apart are decided without looking at all pairs."""
    rng = np.random.default_rng(5)
    team = random_team(rng, dimension=2, planning=2, waiting=0, candidates=40)
    objective, *_ = built(team, PlannerSettings(objective='paper'))
    _, _, exact, evaluated = objective.search()
    assert exact
    assert evaluated < 1600 / 2


@pytest.mark.parametrize('kind', ['paper', 'information'])
def test_choice_in_turn_close_to_optimum(kind):
    """Choosing in turn with improvement stays within 2 % of the optimum."""
    for seed in range(25):
        rng = np.random.default_rng(3000 + seed)
        team = random_team(rng, dimension=2, planning=3, waiting=0, candidates=8)
        settings = {'objective': kind, 'control_weight': 0.0}
        exact_value = built(team, PlannerSettings(**settings))[0].search()[1]
        objective = built(team, PlannerSettings(**settings, enumeration_limit=1))[0]
        _, value, exact, _ = objective.search()
        assert not exact
        assert value <= exact_value + 1e-12 * abs(exact_value)
        assert value >= exact_value - 0.02 * abs(exact_value)


def test_own_measurement_with_certain_view():
    """With pi = 1 around the robot, (22) is zero; before the measurement it is not."""
    rng = np.random.default_rng(8)
    team = random_team(rng, dimension=2, planning=1, waiting=0, candidates=5, kinds=('box',))
    name = team.planning()[0]
    team.robots[name].sensor.detection = BoxDetection([-0.3, -0.3], [0.3, 0.3])
    literal = make_planner('maasi', PlannerSettings(objective='paper')).decide(team)
    assert (literal.robots[name].exploration == 0.0).all()
    before = make_planner(
        'maasi', PlannerSettings(objective='paper', own_measurement=False)
    ).decide(team)
    assert (before.robots[name].exploration > 0.0).any()


def test_blocks_keep_what_is_unseen():
    """Coarser nodes leave the expected new targets about the same where pi is smooth."""
    rng = np.random.default_rng(12)
    team = random_team(rng, dimension=3, planning=1, waiting=0, candidates=5, spacing=10.0)
    fine = built(team, PlannerSettings(exploration_nodes=1_000_000))[0].alone()[:, 1]
    coarse = built(team, PlannerSettings(exploration_nodes=3000))[0].alone()[:, 1]
    assert coarse == pytest.approx(fine, rel=0.02)


def test_order_of_robots_does_not_matter():
    rng = np.random.default_rng(21)
    team = random_team(rng, dimension=2, planning=3, waiting=1, candidates=5)
    first = make_planner('maasi').decide(team)
    team.robots = dict(reversed(list(team.robots.items())))
    second = make_planner('maasi').decide(team)
    assert list(first.robots) == list(second.robots)
    for name in first.robots:
        assert first.robots[name].chosen == second.robots[name].chosen
        assert (first.robots[name].objective == second.robots[name].objective).all()
    assert first.objective == second.objective


def test_reported_terms_belong_to_the_choice():
    """The sum of the chosen J is the objective, and J is made of C, T, E and K."""
    rng = np.random.default_rng(22)
    team = random_team(rng, dimension=2, planning=2, waiting=1, candidates=6)
    settings = PlannerSettings(objective='paper', alpha=0.3, beta=0.9, control_weight=0.2)
    decision = make_planner('maasi', settings).decide(team)
    total = 0.0
    for robot in decision.robots.values():
        expected = (
            -0.2 * robot.control_cost + 0.3 * robot.target_refinement + 0.9 * robot.exploration
        ) / robot.lengths
        fine = np.isfinite(robot.objective)
        assert robot.objective[fine] == pytest.approx(expected[fine], rel=1e-12)
        total += robot.objective[robot.chosen]
        assert robot.positions.shape == (robot.length + 1, 3)
        period = 1
        assert robot.measurements[robot.chosen] >= robot.length // (period * 100)
    assert decision.objective == pytest.approx(total, rel=1e-12)
