"""Check a run of the fault campaign: exit code, recording and report."""

from __future__ import annotations

import json
import math

import numpy as np
from chaos_cases import SIM, Case
from chaos_execution import Outcome
from numpy.typing import NDArray

from maasi_sim.run.bag import Bag, BagError

FloatArray = NDArray[np.float64]

# From a driver's last state until its robot stands, and from the last update of the filter until
# all do: held after 5 s, and then braking [s].
DRIVER_STOP, FILTER_STOP = 2.5, 7.0
# Without the guard the run itself stops the robot, after 5 s [s].
UNGUARDED_STOP = 7.0
# A drone that flies at 3 m/s brakes for longer [s].
DRONE_BRAKING = 4.0
# Below this speed, noise of odometry, a robot is at rest [m/s].
STANDING = 0.06
_CODES = {True: (3,), False: (0, 1)}


def judge(case: Case, outcome: Outcome) -> list[str]:
    """Return violations of the guarantees; empty if it passes."""
    if not outcome.struck:
        return [f'the fault was not injected: exit code {outcome.code}']
    problems = []
    expected = _CODES[case.ends_the_run]
    if outcome.code not in expected:
        problems.append(f'exit code: got {outcome.code}, guaranteed is one of {expected}')
    if case.ends_the_run:
        named = [node for node in case.nodes if node in outcome.output]
        if not named:
            problems.append(f'output: names none of {", ".join(case.nodes)}')
    if outcome.left:
        problems.append(f'processes left: {"; ".join(outcome.left)}')
    problems += _judge_report(outcome)
    try:
        with Bag(outcome.folder / 'bag') as bag:
            problems += _judge_bag(case, bag)
    except (BagError, OSError) as error:
        problems.append(f'recording: {error}')
    return problems


def _judge_report(outcome: Outcome) -> list[str]:
    try:
        report = json.loads((outcome.folder / 'report.json').read_text(encoding='utf-8'))
        return [] if report.get('end_reason') else ['report: without a reason of the end']
    except (OSError, ValueError) as error:
        return [f'report: {error}']


def _judge_bag(case: Case, bag: Bag) -> list[str]:
    if case.when == 'middle' and not any(True for _ in bag.raw(['/clock'])):
        return ['recording: holds no time']
    robots = list(case.scenario()['robots'])
    problems = []
    if case.kind != 'buildings':
        problems += _judge_found(bag)
        if not case.lockstep:
            problems += _judge_gaps(case, bag, robots)
    # Without the simulation there are no robots.
    if SIM not in case.nodes or case.fault == 'pause':
        problems += [_judge_last_command(bag, name) for name in robots]
    return [problem for problem in problems if problem]


def _judge_found(bag: Bag) -> list[str]:
    """Check that found targets are never lost and keep their ids."""
    problems: list[str] = []
    before, ids = 0, set[int]()
    for item in bag.messages(['/filter_update']):
        found = int(item.message.found)
        if found < before:
            problems.append(
                f'filter_update {item.message.batch_id}: {found} found targets after {before}'
            )
        before = max(before, found)
    for item in bag.messages(['/found_targets']):
        now = [int(target.id) for target in item.message.targets]
        if len(set(now)) != len(now):
            problems.append(f'found_targets: duplicate id in {now}')
        if lost := sorted(ids - set(now)):
            problems.append(f'found_targets: without {lost} that were found')
        ids |= set(now)
    return problems


def _judge_gaps(case: Case, bag: Bag, robots: list[str]) -> list[str]:
    """Check, free running, that a robot stands while its driver or the filter is silent."""
    problems = []
    updates = _times(bag, '/filter_update')
    end = max(_times(bag, '/clock'), default=0.0)
    held = FILTER_STOP + (DRONE_BRAKING if case.kind == 'mavlink' else 0.0)
    for name in robots:
        speeds = _speeds(bag, name)
        patience = UNGUARDED_STOP if f'/{name}/guard' in case.nodes else DRIVER_STOP
        silences = [
            (since + patience, until, f'its driver is silent since {since:.1f} s')
            for since, until in _gaps(_times(bag, f'/{name}/state'), end, patience)
        ]
        silences += [
            (since + held, until, f'the filter is silent since {since:.1f} s')
            for since, until in _gaps(updates, end, held)
            if '/planner_node' not in case.nodes
        ]
        for begin, until, text in silences:
            rows = speeds[(speeds[:, 0] > begin) & (speeds[:, 0] < until)]
            moving = rows[rows[:, 1] > STANDING]
            if len(moving):
                problems.append(
                    f'{name} moves at {moving[0, 1]:.2f} m/s at {moving[0, 0]:.1f} s, though {text}'
                )
    return problems


def _gaps(times: list[float], end: float, least: float) -> list[tuple[float, float]]:
    """Return gaps between messages longer than `least`, up to the end of the recording."""
    if not times:
        return []
    pairs = zip(times, [*times[1:], end])
    return [(since, until) for since, until in pairs if until - since > least]


def _times(bag: Bag, topic: str) -> list[float]:
    return [time * 1e-9 for _, _, time, _ in bag.raw([topic])]


def _speeds(bag: Bag, robot: str) -> FloatArray:
    """Return time [s] and speed [m/s] of a robot, (n, 2).

    From its odometry, or, where it has none, its state; that of an autopilot may land it.
    """
    rows: list[tuple[float, float]] = []
    for topic, up in ((f'/{robot}/odom', 1.0), (f'/{robot}/state', 0.0)):
        for item in () if rows else bag.messages([topic]):
            stamp, twist = item.message.header.stamp, item.message.twist
            linear = getattr(twist, 'twist', twist).linear
            speed = math.hypot(linear.x, linear.y, up * linear.z)
            rows.append((stamp.sec + 1e-9 * stamp.nanosec, speed))
    return np.array(rows, dtype=float).reshape(-1, 2)


def _judge_last_command(bag: Bag, robot: str) -> str:
    """Check that the last command of a robot is zero."""
    last = None
    for item in bag.messages([f'/{robot}/cmd_vel']):
        last = item.message
    if last is None:
        return ''
    twist = getattr(last, 'twist', last)
    values = (twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z)
    return '' if not any(values) else f'{robot}: the last command is {values}, guaranteed are zeros'
