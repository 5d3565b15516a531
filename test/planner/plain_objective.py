"""The objective straight from the formulas, whole grid and all: slow, to compare with."""

from typing import NamedTuple

import numpy as np

from maasi_filter.models.pose import Pose


class Shot(NamedTuple):
    """A predicted measurement; `counts` for the robot that takes it."""

    step: int
    pose: Pose
    counts: bool


def shots_of(team, name, options, choice, settings, horizon):
    """Return the measurements of one robot until a horizon."""
    view = team.robots[name]
    if view.planning:
        way, w = options[name].prediction, choice[name]
        positions, yaws, last = way.positions[w], way.yaws[w], int(way.lengths[w])
        phase, arrives = 0, settings.measure_at_arrival
    else:
        positions, yaws, phase = view.remaining_path, view.remaining_yaws, view.phase
        if positions is None:
            positions = view.state.pose.position[None, :]
        if yaws is None:
            yaws = np.full(len(positions), view.state.pose.yaw)
        last = len(positions) - 1
        arrives = last > 0  # it plans there, and measures then
    out = []
    for step in range(horizon + 1):
        k = min(step, last)
        regular = step >= phase and (step - phase) % view.period_steps == 0
        own = (regular and step < last) or (arrives and step == last)
        if own or (regular and settings.extension == 'measuring'):
            out.append(Shot(step, Pose.from_yaw(positions[k], yaws[k]), own))
    return out


def objective_of(team, settings, options, choice, name, refinement, exploration):
    way, w = options[name].prediction, choice[name]
    norm = way.distances()[w] if settings.normalisation == 'distance' else way.lengths[w]
    gain = settings.alpha * refinement + settings.beta * exploration
    return refinement, exploration, (gain - settings.control_weight * way.control_cost[w]) / norm


def plain_terms(team, settings, options, choice):
    """Return {robot: (T, E, J)} of a joint choice under the objective `paper`."""
    planning = team.planning()
    horizon = max(int(options[name].prediction.lengths.max()) for name in planning)
    shots = {
        name: shots_of(team, name, options, choice, settings, horizon) for name in team.names()
    }
    detections = {name: team.robots[name].sensor.detection for name in team.names()}
    explored = team.exploration.copy()
    terms = {name: [0.0, 0.0] for name in planning}
    centres = np.array([cluster.position for cluster in team.clusters])
    for k in range(horizon + 1):
        now = [(name, shot) for name in team.names() for shot in shots[name] if shot.step == k]
        for name, shot in now:
            explored.update(detections[name], shot.pose)
        for name, shot in now:
            if name in planning and shot.counts and (k > 0 or settings.count_present):
                terms[name][0] += float(detections[name].probability(centres, shot.pose).sum())
                terms[name][1] += float(explored.at(shot.pose.position)[0])
    return {
        name: objective_of(team, settings, options, choice, name, *terms[name]) for name in planning
    }


def information(team, name, shots):
    """Return sum pi H' R^-1 H per cluster of measurements of one robot."""
    view, d = team.robots[name], team.dimension
    out = np.zeros((len(team.clusters), d, d))
    inverse = np.linalg.inv(view.sensor.covariance)
    least = np.sqrt(view.sensor.covariance[0, 0])
    for total, cluster in zip(out, team.clusters):
        for shot in shots:
            p = float(view.sensor.detection.probability(cluster.position[None, :], shot.pose)[0])
            offset = cluster.position - shot.pose.position[:d]
            offset = offset * max(1.0, least / np.linalg.norm(offset))
            h = view.sensor.measurement.jacobian(offset[None, :], Pose(np.zeros(3)))[0]
            total += p * h.T @ inverse @ h
    return out


def plain_information_terms(team, settings, options, choice):
    """Return {robot: (T, E, J)} of a joint choice under the objective `information`."""
    planning = team.planning()
    lengths = {name: int(options[name].prediction.lengths[choice[name]]) for name in planning}
    known, base, measured, own = team.exploration.copy(), 0.0, {}, {}
    for name in team.names():
        path = team.robots[name].remaining_path
        horizon = lengths[name] if name in lengths else 0 if path is None else len(path) - 1
        shots = shots_of(team, name, options, choice, settings, horizon)
        shots = [shot for shot in shots if shot.counts]
        if name in lengths:
            first = 0 if settings.count_present else 1
            measured[name] = shots[first:]
            own[name] = information(team, name, measured[name])
            shots = shots[:first]
        # What does not depend on the choice is known before.
        base = base + information(team, name, shots)
        for shot in shots:
            known.update(team.robots[name].sensor.detection, shot.pose)
    out = {}
    for name in planning:
        explored, others = known.copy(), base
        # What two robots see counts for the one with the shorter way.
        for other in planning:
            if (lengths[other], other) < (lengths[name], name):
                others = others + own[other]
                for shot in measured[other]:
                    explored.update(team.robots[other].sensor.detection, shot.pose)
        refinement = 0.0
        for cluster, given, gain in zip(team.clusters, others, own[name]):
            eye = np.eye(team.dimension)
            before = np.linalg.slogdet(eye + cluster.covariance @ given)[1]
            after = np.linalg.slogdet(eye + cluster.covariance @ (given + gain))[1]
            refinement += 0.5 * min(1.0, cluster.mass) * (after - before)
        # (N0 / V) sum over nodes of e (1 - prod(1 - pi)) times the node's volume.
        missed = np.ones(explored.values.size)
        for shot in measured[name]:
            detection = team.robots[name].sensor.detection
            missed *= 1.0 - detection.probability(explored.nodes(), shot.pose)
        share = (explored.cell_volumes() * explored.values).ravel() / explored.volume
        exploration = team.area.expected_targets * float(share @ (1.0 - missed))
        out[name] = objective_of(team, settings, options, choice, name, refinement, exploration)
    return out
