"""002, equations (12) to (16): each agent's exploration has its own measurements only."""

import itertools

import numpy as np
import pytest
from test_coordinator import make, there

from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap

WIDTH = {'a': 3.0, 'b': 1.0}
ALPHA = 5.0
ROBOTS = {
    name: {
        'candidates': {'ring': 4, 'distance': 1.5},
        'motion': {'speed': 10.0, 'tolerance': 0.01},
        'sensor': {
            'period': 0.1,
            'detection': {'kind': 'exponential', 'probability': 0.98, 'size': [width, width]},
            'noise': {'range': 0.1, 'bearing': 0.1},
        },
        'radius': 0.0,
    }
    for name, width in WIDTH.items()
}


def explored(measured, **planner):
    """Return a coordinator whose robots have measured at places."""
    coordinator = make(ROBOTS, 0.25, **({'name': 'maas', 'alpha': ALPHA} | planner))
    for name, place in measured:
        coordinator.absorb({name: Pose(np.array([*place, 0.0]))}, [])
    return coordinator


def literal_exploration(measured, names):
    """Return iota (12) of what `names` have measured."""
    grid = UnexploredMap(np.array([[0.0, 10.0], [0.0, 10.0]]), 0.25)
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
    iota = {
        name: literal_exploration(measured, list(WIDTH) if shared else [name]) for name in WIDTH
    }
    steps = [(1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5)]
    ring = [[np.add(places[name], step) for step in steps] for name in WIDTH]

    def value(pair):
        return ALPHA * iota['a'].at(pair[0])[0] * iota['b'].at(pair[1])[0]

    best = max(itertools.product(*ring), key=value)
    return value(best), dict(zip(WIDTH, best))


@pytest.mark.parametrize('choice', ['own', 'shared'])
def test_the_joint_choice_is_the_literal_product(choice):
    different = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        measured = [(name, tuple(rng.uniform(1.0, 9.0, 2))) for _ in range(5) for name in WIDTH]
        places = {name: rng.uniform(3.0, 7.0, 2) for name in WIDTH}
        decision = explored(measured, agent_exploration=choice).plan(0, there(**places))
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
    coordinator = explored([('a', (5.0, 5.0))])
    decision = coordinator.plan(0, there(b=(5.0, 3.5)))
    # One step up, b is where a measured: by its own e the place is as good as any.
    assert decision.robots['b'].exploration == pytest.approx(np.ones(4))
    # What is published, and what decides about the end, is the exploration of the team.
    assert coordinator.exploration.at([[5.0, 5.0]])[0] == pytest.approx(0.02)
    other = explored([('a', (5.0, 5.0))], name='maasi')
    assert all(robot.exploration is None for robot in other.robots.values())
