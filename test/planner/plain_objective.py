"""The objective straight from the formulas, whole grid and all: slow, to compare with."""

from __future__ import annotations

import itertools

import numpy as np

from maasi_filter.models.pose import Pose


def measurement_steps(team, name, trajectories, choice, weights, horizon):
    """Return [(step, position, yaw, counts for the robot itself)] of one robot."""
    view = team.robots[name]
    out = []
    if view.planning:
        w = choice[name]
        prediction = trajectories[name]
        length = int(prediction.lengths[w])
        for step in range(horizon + 1):
            k = min(step, length)
            pose = (prediction.positions[w, k], prediction.yaws[w, k])
            regular = step % view.period_steps == 0
            arrives = weights.arrival and step == length
            counts = (regular and step < length) or arrives
            if counts or (regular and weights.extend):
                out.append((step, *pose, counts and (step > 0 or weights.present)))
        return out
    path = view.remaining_path
    if path is None:
        path = view.state.pose.position[None, :]
    yaws = (
        view.remaining_yaws
        if view.remaining_path is not None and view.remaining_yaws is not None
        else np.full(len(path), view.state.pose.yaw)
    )
    last = len(path) - 1
    for step in range(horizon + 1):
        k = min(step, last)
        regular = step >= view.phase and (step - view.phase) % view.period_steps == 0
        arrives = last > 0 and step == last
        if (regular and (step < last or weights.extend)) or arrives:
            out.append((step, path[k], yaws[k], False))
    return out


def plain_terms(team, settings, trajectories, choice):
    """Return {robot: (C, T, E, J)} of a joint choice under the objective `paper`."""
    weights = settings.weights()
    planning = team.planning()
    horizon = max(int(trajectories[name].lengths.max()) for name in planning)
    steps = {
        name: measurement_steps(team, name, trajectories, choice, weights, horizon)
        for name in team.names()
    }
    explored = team.exploration.copy()
    exploration = dict.fromkeys(planning, 0.0)
    refinement = dict.fromkeys(planning, 0.0)
    centres = np.array([cluster.position for cluster in team.clusters])
    for k in range(horizon + 1):
        now = [(name, entry) for name in team.names() for entry in steps[name] if entry[0] == k]
        for name, (_, position, yaw, _) in now:
            explored.update(team.robots[name].sensor.detection, Pose.from_yaw(position, yaw))
        for name, (_, position, yaw, counts) in now:
            if counts:
                exploration[name] += float(explored.at(position)[0])
                if len(centres):
                    detection = team.robots[name].sensor.detection
                    refinement[name] += float(
                        detection.probability(centres, Pose.from_yaw(position, yaw)).sum()
                    )
    out = {}
    for name in planning:
        w = choice[name]
        cost = float(trajectories[name].control_cost[w])
        norm = (
            float(trajectories[name].distances()[w])
            if weights.per_distance
            else float(trajectories[name].lengths[w])
        )
        value = (
            -weights.control * cost
            + weights.alpha * refinement[name]
            + weights.beta * exploration[name]
        ) / norm
        out[name] = (cost, refinement[name], exploration[name], value)
    return out


def information(team, name, trajectories, w, weights, present_only=False):
    """Return sum pi H' R^-1 H per cluster of one robot's own measurements."""
    view = team.robots[name]
    d = team.dimension
    horizon = (
        int(trajectories[name].lengths[w])
        if view.planning
        else (len(view.remaining_path) - 1 if view.remaining_path is not None else 0)
    )
    if view.planning:
        steps = measurement_steps(
            team, name, trajectories, {name: w}, weights._replace(present=True), horizon
        )
        steps = [entry for entry in steps if entry[3]]
        if present_only:
            steps = steps[:1]
        elif not weights.present:
            steps = steps[1:]
    else:
        path = view.remaining_path if view.remaining_path is not None else np.zeros((0, 3))
        last = len(path) - 1
        yaws = view.remaining_yaws if view.remaining_yaws is not None else np.zeros(len(path))
        steps = [
            (k, path[k], yaws[k], True)
            for k in range(max(last, 0) + 1)
            if len(path)
            and (
                (k >= view.phase and (k - view.phase) % view.period_steps == 0 and k < last)
                or (k == last and last > 0)
            )
        ]
    out = np.zeros((len(team.clusters), d, d))
    inverse = np.linalg.inv(view.sensor.covariance)
    for index, cluster in enumerate(team.clusters):
        for _, position, yaw, _ in steps:
            pose = Pose.from_yaw(position, yaw)
            p = float(view.sensor.detection.probability(cluster.position[None, :], pose)[0])
            offset = cluster.position - position[:d]
            size = np.sqrt((offset**2).sum())
            least = np.sqrt(view.sensor.covariance[0, 0])
            if size < least:
                offset = offset * least / size
            h = view.sensor.measurement.jacobian(offset[None, :], Pose(np.zeros(3)))[0]
            out[index] += p * h.T @ inverse @ h
    return out, steps


def plain_information_terms(team, settings, trajectories, choice):
    """Return {robot: (C, T, E, J)} of a joint choice under the objective `information`."""
    weights = settings.weights()
    planning = team.planning()
    own, present, measured = {}, {}, {}
    for name in team.names():
        if team.robots[name].planning:
            own[name], measured[name] = information(team, name, trajectories, choice[name], weights)
            if not weights.present:
                present[name] = information(team, name, trajectories, choice[name], weights, True)
        else:
            present[name] = information(team, name, trajectories, 0, weights)
    base = np.zeros((len(team.clusters), team.dimension, team.dimension))
    known = team.exploration.copy()
    for name, (matrices, steps) in present.items():
        base += matrices
        for _, position, yaw, _ in steps:
            known.update(team.robots[name].sensor.detection, Pose.from_yaw(position, yaw))
    out = {}

    def order(name):
        return float(trajectories[name].lengths[choice[name]]), name

    for name in planning:
        explored = known.copy()
        others = base.copy()
        # What two robots see counts for the one with the shorter way.
        for other in planning:
            if order(other) < order(name):
                others += own[other]
                for _, position, yaw, _ in measured[other]:
                    explored.update(
                        team.robots[other].sensor.detection, Pose.from_yaw(position, yaw)
                    )
        refinement = 0.0
        for index, cluster in enumerate(team.clusters):
            eye = np.eye(team.dimension)
            before = np.linalg.slogdet(eye + cluster.covariance @ others[index])[1]
            after = np.linalg.slogdet(
                eye + cluster.covariance @ (others[index] + own[name][index])
            )[1]
            refinement += 0.5 * min(1.0, cluster.mass) * (after - before)
        steps = measured[name]
        exploration = 0.0
        if steps:
            # (N0 / V) sum over nodes of e (1 - prod(1 - pi)) times the node's volume.
            missed = np.ones(explored.values.size)
            for _, position, yaw, _ in steps:
                pose = Pose.from_yaw(position, yaw)
                missed *= 1.0 - team.robots[name].sensor.detection.probability(
                    explored.nodes(), pose
                )
            share = (explored.cell_volumes() * explored.values).ravel() / explored.volume
            exploration = settings.expected_targets * float(share @ (1.0 - missed))
        cost = float(trajectories[name].control_cost[choice[name]])
        norm = float(trajectories[name].lengths[choice[name]])
        value = (
            -weights.control * cost + weights.alpha * refinement + weights.beta * exploration
        ) / norm
        out[name] = (cost, refinement, exploration, value)
    return out


def all_choices(candidates):
    """Yield every joint choice {robot: index}."""
    names = sorted(candidates)
    for indices in itertools.product(*(range(len(candidates[name])) for name in names)):
        yield dict(zip(names, indices))
