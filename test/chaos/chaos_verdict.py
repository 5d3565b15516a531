"""Check a run of the fault campaign: exit code, recording and report."""

import json
import math

import numpy as np
from chaos_cases import SIM

from maasi_sim.run.bag import Bag, BagError

# From a driver's last state until its robot stands, and from the last update of the filter until
# all do: held after 5 s, and then braking [s].
DRIVER_STOP, FILTER_STOP = 2.5, 7.0
# Without the guard the run itself stops the robot, after 5 s [s].
UNGUARDED_STOP = 7.0
# A drone that flies at 3 m/s brakes for longer [s].
DRONE_BRAKING = 4.0
# Below this speed, noise of odometry, a robot is at rest [m/s].
STANDING = 0.06


def judge(case, outcome):
    """Return violations of the guarantees; empty if it passes."""
    if not outcome.struck:
        return [f'the fault was not injected: exit code {outcome.code}']
    problems = []
    expected = (3,) if case.ends_the_run else (0, 1)
    if outcome.code not in expected:
        problems.append(f'exit code: got {outcome.code}, guaranteed is one of {expected}')
    if case.ends_the_run and not any(node in outcome.output for node in case.nodes):
        problems.append(f'output: names none of {", ".join(case.nodes)}')
    if outcome.left:
        problems.append(f'processes left: {"; ".join(outcome.left)}')
    try:
        report = json.loads((outcome.folder / 'report.json').read_text(encoding='utf-8'))
        if not report.get('end_reason'):
            problems.append('report: without a reason of the end')
    except (OSError, ValueError) as error:
        problems.append(f'report: {error}')
    try:
        with Bag(outcome.folder / 'bag') as bag:
            problems += judge_bag(case, bag)
    except (BagError, OSError) as error:
        problems.append(f'recording: {error}')
    return problems


def judge_bag(case, bag):
    if case.when == 'middle' and not times_of(bag, '/clock'):
        return ['recording: holds no time']
    robots = list(case.scenario()['robots'])
    problems = []
    if case.kind != 'buildings':
        problems += judge_found(bag)
        if not case.lockstep:
            problems += judge_gaps(case, bag, robots)
    # Without the simulation there are no robots.
    if SIM not in case.nodes or case.fault == 'pause':
        problems += judge_last_commands(bag, robots)
    return problems


def judge_found(bag):
    """Check that found targets are never lost and keep their ids."""
    problems = []
    before, ids = 0, set()
    for item in bag.messages(['/filter_update']):
        found, number = item.message.found, item.message.batch_id
        if found < before:
            problems.append(f'filter_update {number}: {found} found targets after {before}')
        before = max(before, found)
    for item in bag.messages(['/found_targets']):
        now = [int(target.id) for target in item.message.targets]
        if len(set(now)) != len(now):
            problems.append(f'found_targets: duplicate id in {now}')
        if lost := sorted(ids - set(now)):
            problems.append(f'found_targets: without {lost} that were found')
        ids |= set(now)
    return problems


def judge_gaps(case, bag, robots):
    """Check, free running, that a robot stands while its driver or the filter is silent."""
    problems = []
    end = max(times_of(bag, '/clock'), default=0.0)
    held = FILTER_STOP + (DRONE_BRAKING if case.kind == 'mavlink' else 0.0)
    for name in robots:
        patience = UNGUARDED_STOP if f'/{name}/guard' in case.nodes else DRIVER_STOP
        silences = [('its driver', patience, f'/{name}/state')]
        if '/planner_node' not in case.nodes:
            silences.append(('the filter', held, '/filter_update'))
        speeds = speeds_of(bag, name)
        for who, patience, topic in silences:
            times = times_of(bag, topic)
            for since, until in zip(times, [*times[1:], end]):
                inside = (speeds[:, 0] > since + patience) & (speeds[:, 0] < until)
                moving = speeds[inside & (speeds[:, 1] > STANDING)]
                if len(moving):
                    problems.append(
                        f'{name} moves at {moving[0, 1]:.2f} m/s at {moving[0, 0]:.1f} s, though '
                        f'{who} is silent since {since:.1f} s'
                    )
    return problems


def times_of(bag, topic):
    return [time * 1e-9 for _, _, time, _ in bag.raw([topic])]


def speeds_of(bag, robot):
    """Return time [s] and speed [m/s] of a robot, (n, 2).

    From its odometry, or, where it has none, its state; that of an autopilot may land it.
    """
    rows = []
    for topic, up in ((f'/{robot}/odom', 1.0), (f'/{robot}/state', 0.0)):
        for item in () if rows else bag.messages([topic]):
            stamp, twist = item.message.header.stamp, item.message.twist
            linear = getattr(twist, 'twist', twist).linear
            speed = math.hypot(linear.x, linear.y, up * linear.z)
            rows.append((stamp.sec + 1e-9 * stamp.nanosec, speed))
    return np.array(rows, dtype=float).reshape(-1, 2)


def judge_last_commands(bag, robots):
    topics = {f'/{robot}/cmd_vel': robot for robot in robots}
    last = {topics[item.topic]: item.message for item in bag.messages(topics)}
    problems = []
    for robot, message in last.items():
        twist = getattr(message, 'twist', message)
        values = (twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z)
        if any(values):
            problems.append(f'{robot}: the last command is {values}, guaranteed are zeros')
    return problems
