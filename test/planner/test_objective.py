"""The clever objective against the plain one, and the joint search against enumeration."""

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from plain_objective import plain_information_terms, plain_terms
from planner_helpers import field_team, random_team

from maasi_filter.models.detection import BoxDetection, ExponentialDetection
from maasi_planner import (
    make_planner,
    planner_settings,
)
from maasi_planner.objective import team_objective
from maasi_planner.objective.candidate_table import total_value
from maasi_planner.objective.joint_search import _search_in_turn, ranking_of, search
from maasi_planner.objective.team_objective import TeamObjective
from maasi_planner.planners.options import waiting_places
from maasi_planner.planners.separation import all_apart, free_of_robots
from maasi_planner.team import UsableCandidates


def built(team, settings):
    """Return the objective of a team with all its candidates, and these."""
    options, places = {}, waiting_places(team)
    for name in team.planning():
        view = team.robots[name]
        way = view.motion.predict(view.state, view.candidates, team.step_time)
        free = free_of_robots(view.candidates, view.radius, places)
        options[name] = UsableCandidates(
            view.candidates, way, free & way.reached & (way.lengths > 0)
        )
    return TeamObjective(team, settings, options), options


def best_of(team, settings):
    """Return the best joint choice of a team, its value, whether it is exact, and the work done."""
    objective, _ = built(team, settings)
    return search(objective.table, objective.alone[:, 2], settings)


def choices(options):
    """Return every joint choice: name to index, and indices into all candidates."""
    counts = [len(option.points) for option in options.values()]
    starts = np.array([0, *counts[:-1]]).cumsum()
    return [
        (dict(zip(options, rows)), starts + np.array(rows))
        for rows in itertools.product(*map(range, counts))
    ]


# Of the benchmarks: the memory of this process.
sys.path.append(str(Path(__file__).resolve().parents[1] / 'benchmarks'))
from scale_benchmark import forget_peak, peak  # noqa: E402

CASES = [
    {'dimension': 2, 'planning': 1, 'waiting': 0},
    {'dimension': 2, 'planning': 2, 'waiting': 1},
    {'dimension': 2, 'planning': 3, 'waiting': 0},
    {'dimension': 3, 'planning': 1, 'waiting': 1},
    {'dimension': 3, 'planning': 2, 'waiting': 1},
]


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize(
    ('kind', 'change'),
    [
        ('paper', {}),
        ('paper', {'extension': 'silent'}),
        ('paper', {'measure_at_arrival': True}),
        ('paper', {'count_present': False}),
        ('paper', {'normalisation': 'distance'}),
        ('information', {'count_present': True}),
        ('information', {'count_present': False}),
    ],
)
def test_terms_are_those_of_the_plain_objective(case, kind, change):
    settings = planner_settings(
        objective=kind, alpha=0.7, beta=0.4, exploration_nodes=1_000_000, **change
    )
    plain = plain_terms if kind == 'paper' else plain_information_terms
    for seed in range(3):
        rng = np.random.default_rng(seed)
        team = random_team(rng, candidates=4, **case)
        objective, options = built(team, settings)
        every = choices(options)
        for number in rng.permutation(len(every))[:6]:
            choice, chosen = every[number]
            terms = plain(team, settings, options, choice)
            for i, name in enumerate(objective.names):
                ours = objective.given(i, chosen)[choice[name]]
                assert ours == pytest.approx(terms[name], rel=1e-9, abs=1e-10)
            total = sum(values[2] for values in terms.values())
            assert total_value(objective.table, chosen) == pytest.approx(total, rel=1e-9, abs=1e-10)


@pytest.mark.parametrize('kind', ['paper', 'information'])
@pytest.mark.parametrize('case', [*CASES, {'dimension': 2, 'planning': 2, 'waiting': 2}])
def test_search_is_enumeration(case, kind):
    for seed in range(4):
        rng = np.random.default_rng(1000 + seed)
        team = random_team(rng, candidates=6, radius=0.05, **case)
        settings = planner_settings(objective=kind)
        objective, options = built(team, settings)
        best = max(
            (
                total_value(objective.table, chosen)
                for choice, chosen in choices(options)
                if all(options[name].allowed[w] for name, w in choice.items())
                and all_apart(team, {name: options[name].points[w] for name, w in choice.items()})
            )
        )
        chosen, value, exact, _ = best_of(team, settings)
        assert exact
        assert value == pytest.approx(best, rel=1e-12)
        assert total_value(objective.table, chosen) == value


def test_bound_prunes():
    rng = np.random.default_rng(5)
    team = random_team(rng, dimension=2, planning=2, waiting=0, candidates=40)
    _, _, exact, evaluated = best_of(team, planner_settings(objective='paper'))
    assert exact
    assert evaluated < 1600 / 2


@pytest.mark.parametrize('kind', ['paper', 'information'])
def test_choice_in_turn_is_within_two_percent_of_the_optimum(kind):
    settings = planner_settings(objective=kind, control_weight=0.0)
    few = settings.model_copy(update={'enumeration_limit': 1})
    for seed in range(25):
        rng = np.random.default_rng(3000 + seed)
        team = random_team(rng, dimension=2, planning=3, waiting=0, candidates=8)
        best = best_of(team, settings)[1]
        _, value, exact, _ = best_of(team, few)
        assert not exact
        assert best - 0.02 * abs(best) <= value <= best + 1e-12 * abs(best)


@pytest.mark.parametrize('kind', ['paper', 'information'])
def test_large_teams_choose_what_all_values_lead_to(kind):
    """The choice in turn with the others summed up is that with every value computed again."""
    settings = planner_settings(objective=kind, enumeration_limit=1)
    for seed in range(6):
        rng = np.random.default_rng(4000 + seed)
        team = random_team(
            rng, dimension=2 + seed % 2, planning=7, waiting=1, candidates=6, radius=0.02
        )
        objective, _ = built(team, settings)
        chosen, value, exact, _ = search(objective.table, objective.bounds, settings)
        assert not exact
        assert value == total_value(objective.table, chosen)
        ranking = ranking_of(objective.table, objective.bounds)
        tries = []
        for backwards in (False, True):
            plain = np.full(len(chosen), -1, np.int64)
            total, _ = _search_in_turn(ranking, settings.improvement_rounds, backwards, plain)
            tries.append((int((plain >= 0).sum()), total))
        assert value == pytest.approx(max(tries)[1], rel=1e-6)


def field_of(number, candidates, kind):
    """Return drones in one corner of 200 m x 200 m."""
    detection = ExponentialDetection(0.98, [15.0, 15.0]) if kind == 'exponential' else None
    return field_team(number, 200.0, candidates, 15.0, detection=detection)


@pytest.mark.parametrize('kind', ['box', 'exponential'])
def test_thirty_robots_decide_jointly_in_bounded_memory(kind):
    make_planner('maasi').decide(field_of(7, 4, kind))
    team = field_of(30, 20, kind)
    forget_peak()
    before = peak()
    decision = make_planner('maasi').decide(team)
    assert peak() - before < 300.0
    again = make_planner('maasi').decide(team)
    assert again.objective == decision.objective
    waypoints = np.array([robot.waypoint for robot in decision.robots.values()])
    gaps = np.linalg.norm(waypoints[:, None] - waypoints, axis=2)
    assert gaps[~np.eye(30, dtype=bool)].min() >= 0.6
    assert not any(robot.stays for robot in decision.robots.values())
    for robot in decision.robots.values():
        assert robot.positions.shape == (robot.lengths[robot.chosen] + 1, 3)
        assert np.linalg.norm(robot.positions[-1] - robot.waypoint) <= 0.5 + 1e-9


@pytest.mark.parametrize('kind', ['box', 'exponential'])
def test_few_candidates_cost_little(kind, monkeypatch):
    """Where memory limits the candidates of each robot, those that are best alone are enough."""
    best = make_planner('maasi').decide(field_of(8, 10, kind)).objective
    monkeypatch.setattr(team_objective, 'MOST_ENTRIES', 100_000)
    objective, _ = built(field_of(8, 10, kind), planner_settings())
    assert 8 * team_objective.LEAST_KEPT <= objective.kept.sum() < 0.7 * objective.kept.size
    few = make_planner('maasi').decide(field_of(8, 10, kind)).objective
    assert few >= 0.97 * best


def test_own_measurement_with_certain_view():
    """With pi = 1 around the robot, (22) is zero; before the measurement it is not."""
    rng = np.random.default_rng(8)
    team = random_team(rng, dimension=2, planning=1, waiting=0, candidates=5, kinds=('box',))
    name = team.planning()[0]
    team.robots[name].sensor.detection = BoxDetection([-0.3, -0.3], [0.3, 0.3])
    for own in (True, False):
        settings = planner_settings(objective='paper', own_measurement=own)
        decision = make_planner('maasi', settings).decide(team)
        assert (decision.robots[name].exploration > 0.0).any() != own


def test_blocks_keep_what_is_unseen():
    """Coarser nodes leave the expected new targets about the same where pi is smooth."""
    rng = np.random.default_rng(12)
    team = random_team(rng, dimension=3, planning=1, waiting=0, candidates=5, spacing=10.0)
    fine = built(team, planner_settings(exploration_nodes=1_000_000))[0].alone[:, 1]
    coarse = built(team, planner_settings(exploration_nodes=3000))[0].alone[:, 1]
    assert coarse == pytest.approx(fine, rel=0.02)


def test_order_of_robots_does_not_matter():
    rng = np.random.default_rng(21)
    team = random_team(rng, dimension=2, planning=3, waiting=1, candidates=5)
    first = make_planner('maasi').decide(team)
    team.robots = dict(reversed(list(team.robots.items())))
    second = make_planner('maasi').decide(team)
    assert list(first.robots) == list(second.robots)
    for name, robot in first.robots.items():
        assert robot.chosen == second.robots[name].chosen
        assert (robot.objective == second.robots[name].objective).all()
    assert first.objective == second.objective


def test_reported_terms_belong_to_the_choice():
    rng = np.random.default_rng(22)
    team = random_team(rng, dimension=2, planning=2, waiting=1, candidates=6)
    settings = planner_settings(objective='paper', alpha=0.3, beta=0.9, control_weight=0.2)
    decision = make_planner('maasi', settings).decide(team)
    for robot in decision.robots.values():
        expected = (
            -0.2 * robot.control_cost + 0.3 * robot.target_refinement + 0.9 * robot.exploration
        ) / robot.lengths
        fine = np.isfinite(robot.objective)
        assert robot.objective[fine] == pytest.approx(expected[fine], rel=1e-12)
        assert robot.positions.shape == (robot.length + 1, 3)
    total = sum(robot.objective[robot.chosen] for robot in decision.robots.values())
    assert decision.objective == pytest.approx(total, rel=1e-12)
