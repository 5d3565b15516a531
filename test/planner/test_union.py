"""The objective `information` of a team is that of all its measurements together, the union."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from plain_objective import all_choices, information, measurement_steps
from planner_helpers import random_team

from maasi_filter.models.pose import Pose
from maasi_planner import PlannerSettings, make_motion
from maasi_planner.objective.team_objective import TeamObjective

SETTINGS = PlannerSettings(control_weight=0.0, exploration_nodes=1_000_000)
WEIGHTS = SETTINGS.weights()


def team_of(seed, planning):
    """Return a team on a floor of few nodes."""
    rng = np.random.default_rng(seed)
    team = random_team(
        rng,
        dimension=2,
        planning=planning,
        waiting=0,
        candidates=4,
        kinds=('exponential',),
        spacing=0.5,
    )
    for view in team.robots.values():
        settings = view.motion.settings.model_copy(
            update={'model': 'constant_speed', 'heading': 'keep'}
        )
        view.motion = make_motion(settings)
        # Two measurements at most on any way.
        view.period_steps = 20
    return team


def predictions(team):
    return {
        name: team.robots[name].motion.predict(
            team.robots[name].state, team.robots[name].candidates, team.step_time
        )
        for name in team.planning()
    }


def measured(team, ways, choice):
    """Return (robot, pose) of the measurements now, and of those that the choice adds."""
    now, added = [], []
    for name in team.planning():
        length = int(ways[name].lengths[choice[name]])
        everything = WEIGHTS._replace(present=True)
        steps = measurement_steps(team, name, ways, choice, everything, length)
        for step, position, yaw, counts in steps:
            if counts:
                (added if step else now).append((name, Pose.from_yaw(position, yaw)))
    return now, added


def expected_new_targets(team, ways, choice):
    """Return how many targets that nobody knows of are detected, by all outcomes at each node."""
    exploration = team.exploration
    nodes = exploration.nodes()
    density = SETTINGS.expected_targets / exploration.cell_volumes().sum()
    now, added = measured(team, ways, choice)
    total = 0.0
    for node, e, volume in zip(
        nodes, exploration.values.ravel(), exploration.cell_volumes().ravel()
    ):

        def chance(item, node=node):
            name, pose = item
            detection = team.robots[name].sensor.detection
            return float(detection.probability(node[None], pose)[0])

        unseen = density * volume * e * np.prod([1.0 - chance(item) for item in now])
        seen = [chance(item) for item in added]
        for outcome in itertools.product((False, True), repeat=len(seen)):
            if any(outcome):
                total += unseen * np.prod([p if hit else 1 - p for p, hit in zip(seen, outcome)])
    return float(total)


def expected_information(team, ways, choice):
    """Return what all measurements of the choice tell together about the clusters."""
    base = sum(information(team, n, ways, choice[n], WEIGHTS, True)[0] for n in team.planning())
    own = sum(information(team, n, ways, choice[n], WEIGHTS)[0] for n in team.planning())
    total = 0.0
    for cluster, before, more in zip(team.clusters, base, own):
        matrices = [np.eye(2) + cluster.covariance @ m for m in (before, before + more)]
        first, second = (np.linalg.slogdet(matrix)[1] for matrix in matrices)
        total += 0.5 * min(1.0, cluster.mass) * (second - first)
    return total


@pytest.mark.parametrize('planning', [1, 2, 3])
def test_terms_sum_to_the_union(planning):
    overlaps = 0
    for seed in range(4):
        team = team_of(seed, planning)
        ways = predictions(team)
        candidates = {name: team.robots[name].candidates for name in team.planning()}
        allowed = {name: ways[name].lengths > 0 for name in candidates}
        objective = TeamObjective(team, SETTINGS, candidates, ways, allowed)
        alone = objective.alone()
        choices = list(all_choices(candidates))
        for choice in choices[:: max(1, len(choices) // 5)]:
            chosen = np.array(
                [objective.start[i] + choice[n] for i, n in enumerate(objective.names)], np.int64
            )
            terms = [objective.given(i, chosen)[choice[n]] for i, n in enumerate(objective.names)]
            refinement, exploration = (sum(float(t[k]) for t in terms) for k in (0, 1))
            union = expected_new_targets(team, ways, choice)
            assert exploration == pytest.approx(union, rel=1e-9)
            assert refinement == pytest.approx(expected_information(team, ways, choice), rel=1e-8)
            overlaps += float(alone[chosen, 1].sum()) > 1.02 * union
    assert overlaps > 0 or planning == 1
