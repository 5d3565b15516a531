"""Where the time of a search goes: `./scripts/search_quality --explain`.

The mean time of the robots until 90 % of the targets are found is taken apart, look by look. What a
robot explores counts as the time that a perfect sweep takes for it: at full speed, without gaps,
overlaps and turns. The rest of its time has one cause, the first that applies.
"""

import math
from functools import partial

import numpy as np

from maasi_filter.geometry.area import Area
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.candidates import swath_of
from maasi_sim.experiments.campaign import make_workers
from maasi_sim.experiments.searches import find_times
from maasi_sim.run.facts import Decided, Measured, Updated
from maasi_sim.search import search

SHARE = 0.9
# In this order: explored at the rate of a perfect sweep; slower than at full speed, at a stay or
# otherwise; the share of a look beyond the border; looks at a potential target that was found
# afterwards, or not; other looks at what is explored. The last one is contained in them: from 90 %
# of the targets looked at until 90 % found.
PARTS = (
    *('new ground', 'waiting', 'turns and braking', 'beyond the border'),
    *('second looks, needed', 'second looks, not needed', 'overlap', 'missed detections'),
)
HEAD = ('regime', 'planner', 'runs', '90 % found [s]', 'perfect sweep', *PARTS)
LOOKED_AT = 0.5  # a look shows what is detected with this share of the best probability
CELLS = 6.0  # of the map across a swath
SAME = 3.0  # a cluster within so many standard deviations of the range was a found target


class _Robot:
    """What is known of a robot: its sensor, path, and how much a perfect sweep explores."""

    def __init__(self, settings, path, name, dimension):
        self.sensor, self.path = settings.sensor.build(name, dimension), path
        self.speed = settings.motion.speed
        self.swath = swath_of(self.sensor)
        self.rate = self.speed * self.swath ** (dimension - 1)  # [m^d/s]
        self.last, self.stays = 0.0, False

    def full_speed(self, begin, end):
        """Return for how long it would have moved at full speed [s]."""
        rows = self.path[(self.path[:, 0] >= begin - 1e-9) & (self.path[:, 0] <= end + 1e-9), 1:]
        return float(np.linalg.norm(np.diff(rows, axis=0), axis=1).sum()) / self.speed

    def shows(self, pose, points):
        """Return which points (n, d) a look from a pose shows."""
        probability = self.sensor.detection.probability(points, pose)
        return probability >= LOOKED_AT * self.sensor.detection.gain

    def inside(self, pose, area):
        """Return the share of a look that is within the area, on a circle of half the swath."""
        turns = np.linspace(0.0, 2.0 * math.pi, 16, endpoint=False)
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1) * 0.35 * self.swath
        points = np.tile(pose.position[: area.dimension], (16, 1))
        points[:, :2] += ring
        return float(area.inside(points).mean())


def explained(scenario, seed, planner=None):
    """Run a search; return the time until 90 % are found, of a perfect sweep, and of `PARTS`."""
    log, limit = search(scenario, seed, planner=planner), scenario.limits.time
    number = math.ceil(SHARE * len(log.truth))
    until = float(np.sort(find_times(log, limit))[number - 1])
    area, parts, clusters = Area(scenario.environment), dict.fromkeys(PARTS, 0.0), []
    robots = {
        name: _Robot(scenario.robots[name], path, name, scenario.dimension)
        for name, path in log.trajectories.items()
    }
    seen = UnexploredMap(area, min(robot.swath for robot in robots.values()) / CELLS)
    found = np.array([target.position for target in log.found_targets])
    looked_at = np.full(len(log.truth), np.inf)
    for fact in log.facts:
        match fact:
            case Decided(decision=decision):
                for name, choice in decision.robots.items():
                    robots[name].stays = choice.stays
            case Updated(clusters=clusters):
                pass
            case Measured(time=time, robot=name, pose=pose) if time <= until:
                robot, gone = robots[name], time - robots[name].last
                before = seen.explored_fraction()
                seen.update(robot.sensor.detection, pose)
                explored = (seen.explored_fraction() - before) * seen.volume
                looked_at[robot.shows(pose, log.truth) & np.isinf(looked_at)] = time
                new = min(explored / robot.rate, gone)
                slow = min(max(gone - robot.full_speed(robot.last, time), 0.0), gone - new)
                beyond = (gone - new - slow) * (1.0 - robot.inside(pose, area))
                parts['new ground'] += new
                parts['waiting' if robot.stays else 'turns and braking'] += slow
                parts['beyond the border'] += beyond
                parts[_cause(robot, pose, clusters, found)] += gone - new - slow - beyond
                robot.last = time
    parts = {name: value / len(robots) for name, value in parts.items()}
    parts['missed detections'] = max(until - float(np.sort(looked_at)[number - 1]), 0.0)
    sweep = SHARE * seen.volume / sum(robot.rate for robot in robots.values())
    return [until, sweep, *parts.values()]


def _cause(robot, pose, clusters, found):
    """Return why a robot looked at what is explored."""
    positions = [item.position for item in clusters]
    shown = [position for position in positions if robot.shows(pose, position[None])[0]]
    if not shown:
        return 'overlap'
    near = SAME * math.sqrt(robot.sensor.covariance[0, 0])
    gaps = [np.linalg.norm(found - position, axis=1).min(initial=np.inf) for position in shown]
    return f'second looks, {"needed" if min(gaps) <= near else "not needed"}'


def _run(seed, scenario):
    return explained(scenario, seed)


def rows(scenarios, seeds, jobs):
    """Yield a row of means for each regime and planner: pairs of names and scenarios."""
    workers = make_workers(len(seeds), jobs)
    try:
        for (regime, kind), scenario in scenarios:
            runs = [run for _, run in workers.make(partial(_run, scenario=scenario), list(seeds))]
            means = np.mean(runs, axis=0)
            yield [regime, kind, str(len(runs)), *(f'{value:.3g}' for value in means)]
    finally:
        workers.close()
