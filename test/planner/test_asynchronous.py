"""Robots that decide at different steps: the cases of 000, Fig. 10, by hand.

One dimension of motion on a line, a view that certainly sees 0.3 m to each side, and e kept at
nodes 0.5 m apart, so that each value can be followed with pencil and paper.
"""

from __future__ import annotations

import numpy as np
import pytest

from maasi_filter.models.detection import BoxDetection
from maasi_filter.models.sensor import Sensor
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import (
    MotionSettings,
    PlannerSettings,
    RobotState,
    RobotView,
    TeamView,
    make_motion,
    make_planner,
)

# Half of what is in view is seen at each measurement.
SENSOR = Sensor.ranging('s', BoxDetection([-0.3, -0.3], [0.3, 0.3], 0.5), np.diag([0.01, 0.01]))
PAPER = PlannerSettings(objective='paper', alpha=0.0, beta=1.0, control_weight=0.0)


def robot(x, planning, period, goals=(), remaining_path=None, phase=0):
    """Return a robot on the line y = 2 that moves 0.5 m a step."""
    motion = make_motion(
        MotionSettings(model='constant_speed', speed=0.5, tolerance=0.01, approach_rate=1.0)
    )
    return RobotView(
        state=RobotState.at_rest([x, 2.0, 0.0]),
        candidates=np.array([[goal, 2.0, 0.0] for goal in goals]).reshape(-1, 3),
        motion=motion,
        sensor=SENSOR,
        period_steps=period,
        planning=planning,
        remaining_path=None
        if remaining_path is None
        else np.array([[place, 2.0, 0.0] for place in remaining_path]),
        phase=phase,
    )


def explore(robots, settings=PAPER):
    """Return E of each robot's candidates."""
    exploration = UnexploredMap([[0.0, 10.0], [0.0, 4.0]], 0.5)
    team = TeamView(0, 1.0, robots, [], exploration)
    return {
        name: decision.exploration
        for name, decision in make_planner('maasi', settings).decide(team).robots.items()
    }


def test_tail_longer_than_the_horizon():
    """The other robot passes 1 at step 1 (in time) and 0.5 only after step 4 (too late)."""
    path = [1.5, 1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5]
    other = robot(1.5, False, 1, remaining_path=path, phase=1)
    result = explore({'a': robot(0.0, True, 1, [2.0]), 'b': other})
    # a measures 0 at step 0, 0.5 at 1, 1 at 2, 1.5 at 3. b halves node 1 at steps 1 and 2.
    assert result['a'] == pytest.approx([0.5 + 0.5 + 0.5 * 0.25 + 0.5])


def test_tail_shorter_than_the_horizon_is_extended():
    """The other robot arrives at 1.5 at step 1 and stays there, measuring on."""
    other = robot(2.0, False, 1, remaining_path=[2.0, 1.5], phase=0)
    result = explore({'a': robot(0.0, True, 1, [2.0]), 'b': other})
    # Node 1.5 is halved at steps 1, 2 and 3 by b, and at 3 by a itself.
    assert result['a'] == pytest.approx([0.5 + 0.5 + 0.5 + 0.5 * 0.125])
    silent = PAPER.model_copy(update={'extension': 'silent'})
    result = explore({'a': robot(0.0, True, 1, [2.0]), 'b': other}, silent)
    # Without measurements after its arrival only the one at step 1 counts.
    assert result['a'] == pytest.approx([0.5 + 0.5 + 0.5 + 0.5 * 0.5])


def test_other_measurement_period_and_phase():
    """The other robot waits at 1.5 and measures at steps 1 and 3 only."""
    other = robot(1.5, False, 2, remaining_path=[1.5] * 8, phase=1)
    result = explore({'a': robot(0.0, True, 1, [2.0]), 'b': other})
    assert result['a'] == pytest.approx([0.5 + 0.5 + 0.5 + 0.5 * 0.25])
    later = robot(1.5, False, 2, remaining_path=[1.5] * 8, phase=0)
    result = explore({'a': robot(0.0, True, 1, [2.0]), 'b': later})
    # Now at steps 0 and 2.
    assert result['a'] == pytest.approx([0.5 + 0.5 + 0.5 + 0.5 * 0.25])


def test_joint_decision_of_unequal_lengths():
    """a goes two steps, b four; a waits at 1 and measures on while b comes to it."""
    result = explore({'a': robot(0.0, True, 1, [1.0]), 'b': robot(3.0, True, 1, [1.0])})
    # a: 0 at step 0, 0.5 at step 1; nothing of b is near.
    assert result['a'] == pytest.approx([0.5 + 0.5])
    # b: 3, 2.5, 2, 1.5 at steps 0 to 3, none within reach of a at 1.
    assert result['b'] == pytest.approx([4 * 0.5])
    result = explore({'a': robot(0.0, True, 1, [1.0]), 'b': robot(2.0, True, 1, [0.0])})
    # b: 2, 1.5 at steps 0, 1; 1 at step 2, where a arrives and measures; 0.5 at step 3, which a
    # passed at step 1.
    assert result['b'] == pytest.approx([0.5 + 0.5 + 0.5 * 0.5 + 0.5 * 0.5])
