"""Check a run of the fault campaign: exit code, recording and report."""

import json
import math

import numpy as np
from chaos_cases import SIM

from maasi_sim.run.bag import Bag, BagError

DRIVER_STOP = 2.5  # from a driver's last state until its robot stands [s]
UNGUARDED_STOP = 7.0  # without the guard the run itself stops the robot, after 5 s [s]
# An autopilot without its driver flies to the last set-point, a second's way ahead at 3 m/s, here
# with what was flown since the last state that arrived [m]. It slows down by 1 m/s for each metre
# left: from 3 m/s it is at rest after ln(3 / 0.06) = 3.9 s [s].
AUTOPILOT_WAY, AUTOPILOT_STOP = 3.5, 5.0
STANDING = 0.06  # below this speed, noise of odometry, a robot is at rest [m/s]
# From the first batch without an update of the filter on, how fast a robot may be, and after what
# time: held after 5 s, and then braking. A drone that flies at 3 m/s overshoots, and comes back to
# where it was held [s, m/s].
HELD = {'search': ((7.0, STANDING),), 'mavlink': ((7.0, 1.0), (11.0, STANDING))}


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
    for name in robots:
        silences = []
        if case.kind == 'mavlink':
            problems += judge_autopilot(bag, name)
        else:
            patience = UNGUARDED_STOP if f'/{name}/guard' in case.nodes else DRIVER_STOP
            times = signs_of_driver(bag, name)
            gaps = zip(times, [*times[1:], end])
            silences += [('its driver', patience, STANDING, *gap) for gap in gaps]
        if '/planner_node' not in case.nodes:
            gaps = silences_of_filter(bag, end)
            silences += [('the filter', *held, *gap) for held in HELD[case.kind] for gap in gaps]
        speeds = speeds_of(bag, name)
        for who, patience, limit, since, until in silences:
            inside = (speeds[:, 0] > since + patience) & (speeds[:, 0] < until)
            moving = speeds[inside & (speeds[:, 1] > limit)]
            if len(moving):
                problems.append(
                    f'{name} moves at {moving[0, 1]:.2f} m/s at {moving[0, 0]:.1f} s, though '
                    f'{who} is silent since {since:.1f} s'
                )
    return problems


def signs_of_driver(bag, robot):
    """Return the stamps of a driver's states, and the times at which its guard heard it again."""
    # A restarted driver may move its robot before the recorder has discovered it; the recorder's
    # own times are no measure: on a busy machine it takes no messages for seconds then.
    states = [stamp_of(item.message) for item in bag.messages([f'/{robot}/state'])]
    heard = [
        item.time * 1e-9
        for item in bag.messages(['/rosout'])
        if item.message.name == f'{robot}.guard' and item.message.msg == 'driver available again'
    ]
    return sorted([*states, *heard])


def silences_of_filter(bag, end):
    """Return from when to when there was no update, though a batch waited for one."""
    asked = [(item.message.id, item.time * 1e-9) for item in bag.messages(['/measurement_batch'])]
    answers = [
        (item.message.batch_id, item.time * 1e-9) for item in bag.messages(['/filter_update'])
    ]
    silences, last = [], 0
    for (number, since), (_, until) in zip([(0, 0.0), *answers], [*answers, (0, end)]):
        last = max(last, number)
        first = min((time for batch, time in asked if batch > last), default=end)
        silences.append((max(since, first), until))
    return silences


def judge_autopilot(bag, robot):
    """Check that a vehicle flies no farther than its last set-point without its driver."""
    problems = []
    # Only its driver reports it: the first state after a silence tells what it did.
    before = None
    for item in bag.messages([f'/{robot}/state']):
        state = item.message
        place, linear = state.pose.pose.position, state.twist.linear
        # Before the first pose a driver publishes its start, exactly at rest.
        if not any((linear.x, linear.y, linear.z)):
            continue
        time = stamp_of(state)
        if before is not None:
            since, x, y = before
            way = math.hypot(place.x - x, place.y - y)
            speed = math.hypot(linear.x, linear.y)
            silence = f'while its driver was silent, {since:.1f} to {time:.1f} s'
            if way > AUTOPILOT_WAY:
                problems.append(f'{robot} flew {way:.1f} m {silence}')
            if time > since + AUTOPILOT_STOP and speed > STANDING:
                problems.append(f'{robot} still moves at {speed:.2f} m/s {silence}')
        before = time, place.x, place.y
    return problems


def times_of(bag, topic):
    return [time * 1e-9 for _, _, time, _ in bag.raw([topic])]


def stamp_of(message):
    stamp = message.header.stamp
    return stamp.sec + 1e-9 * stamp.nanosec


def speeds_of(bag, robot):
    """Return time [s] and speed [m/s] of a robot, (n, 2), from its odometry or else its state."""
    rows = []
    # An autopilot, which has no odometry, may land it.
    for topic, up in ((f'/{robot}/odom', 1.0), (f'/{robot}/state', 0.0)):
        for item in () if rows else bag.messages([topic]):
            twist = item.message.twist
            linear = getattr(twist, 'twist', twist).linear
            speed = math.hypot(linear.x, linear.y, up * linear.z)
            rows.append((stamp_of(item.message), speed))
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
