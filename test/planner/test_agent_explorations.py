"""002, equations (12) to (16): each agent's exploration has its own measurements only."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.coordinator import Coordinator, PresentRobot
from maasi_planner.motion import RobotState
from maasi_planner.node_settings import PlannerNodeSettings

BOUNDS = [[0.0, 10.0], [0.0, 10.0]]
WIDTH = {'a': 3.0, 'b': 1.0}
ALPHA = 5.0


def robot(width):
    return {
        'start': [5.0, 5.0, 0.0],
        'candidates': {'ring': 4, 'distance': 1.5},
        'motion': {'speed': 10.0, 'tolerance': 0.01},
        'sensor': {
            'period': 0.1,
            'detection': {'kind': 'exponential', 'probability': 0.98, 'size': [width, width]},
            'noise': {'range': 0.1, 'bearing': 0.1},
        },
        'radius': 0.0,
    }


def make(**planner):
    return Coordinator(
        PlannerNodeSettings.model_validate(
            {
                'step': 0.1,
                'environment': {'bounds': BOUNDS},
                'planner': {'name': 'maas', 'alpha': ALPHA, **planner},
                'robots': {name: robot(width) for name, width in WIDTH.items()},
                'exploration_spacing': 0.25,
            }
        )
    )


def literal_explorations(measured, names):
    """Return iota of each name (12); all of them together for one list of all names."""
    grid = UnexploredMap(np.array(BOUNDS), 0.25)
    nodes = grid.nodes()
    values = np.ones(len(nodes))
    for name, place in measured:
        if name in names:
            zeta = (nodes[:, :2] - np.array(place)) / WIDTH[name]
            values *= 1.0 - 0.98 * np.exp(-0.5 * np.sqrt((zeta**2).sum(axis=1)))
    grid.values[...] = values.reshape(grid.values.shape)
    return grid


def literal_best(measured, places, shared):
    """Return the largest alpha times the product of the e of both (16), and who goes where."""
    names = list(WIDTH)
    iota = {name: literal_explorations(measured, names if shared else [name]) for name in names}
    steps = [(1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5)]
    ring = {name: [np.add(places[name], step) for step in steps] for name in names}
    best = max(
        itertools.product(ring['a'], ring['b']),
        key=lambda pair: iota['a'].at(pair[0])[0] * iota['b'].at(pair[1])[0],
    )
    value = ALPHA * iota['a'].at(best[0])[0] * iota['b'].at(best[1])[0]
    return value, dict(zip(names, best))


def explore(coordinator, measured):
    for name, place in measured:
        coordinator.absorb({name: Pose(np.array([*place, 0.0]))}, [])


@pytest.mark.parametrize('choice', ['own', 'shared'])
def test_the_joint_choice_is_the_literal_product(choice):
    different = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        measured = [
            (name, tuple(rng.uniform(1.0, 9.0, 2))) for _ in range(5) for name in ('a', 'b')
        ]
        places = {'a': rng.uniform(3.0, 7.0, 2), 'b': rng.uniform(3.0, 7.0, 2)}
        coordinator = make(agent_exploration=choice)
        explore(coordinator, measured)
        present = {
            name: PresentRobot(RobotState.at_rest([*place, 0.0]), True)
            for name, place in places.items()
        }
        decision = coordinator.plan(0, present)
        value, best = literal_best(measured, places, choice == 'shared')
        assert decision.objective == pytest.approx(value, rel=1e-9)
        for name, place in best.items():
            assert decision.robots[name].waypoint[:2] == pytest.approx(place)
        other, _ = literal_best(measured, places, choice != 'shared')
        different += abs(other - value) > 1e-3
    # The two readings are not the same on these maps, so that the test tells them apart.
    assert different >= 10


def test_own_explorations_are_the_default():
    """As printed: what one agent has seen is news to the other one."""
    coordinator = make()
    explore(coordinator, [('a', (5.0, 5.0))])
    present = {'b': PresentRobot(RobotState.at_rest([5.0, 3.5, 0.0]), True)}
    decision = coordinator.plan(0, present)
    # One step up, b is where a measured: by its own e the place is as good as any.
    assert decision.robots['b'].exploration == pytest.approx(np.ones(4))
    # What is published, and what decides about the end, is the exploration of the team.
    assert coordinator.exploration.at([[5.0, 5.0]])[0] == pytest.approx(0.02)


def test_other_planners_have_no_explorations_of_their_own():
    coordinator = make(name='maasi')
    present = {'a': PresentRobot(RobotState.at_rest([5.0, 5.0, 0.0]), True)}
    explore(coordinator, [('a', (5.0, 5.0))])
    coordinator.plan(0, present)
    assert all(plan.exploration is None for plan in coordinator._plans.values())
