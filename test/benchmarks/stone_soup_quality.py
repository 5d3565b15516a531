"""The multi-Bernoulli filter beside Stone Soup's JPDA tracker, on the same recorded detections.

    ./scripts/quality --stone-soup [CONDITION ...] [--seeds BLOCK] [--runs N]

A search is run once with `pmb`; its detections, poses and times go to both. GOSPA (c = 10 m,
p = 2) is taken after each measurement and averaged over time. Estimates of `pmb` are found targets
and clusters with a mass above 1/2; those of the JPDA tracker are its tracks, from their second
detection on. It is told pi at each track, as a constant would delete tracks out of view.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np
from stonesoup.base import Property
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.dataassociator.probability import JPDA
from stonesoup.deleter.base import Deleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.initiator.simple import MultiMeasurementInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, RandomWalk
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.tracker.simple import MultiTargetMixtureTracker
from stonesoup.types.array import CovarianceMatrix
from stonesoup.types.detection import Detection
from stonesoup.types.numeric import Probability
from stonesoup.types.state import GaussianState
from stonesoup.types.update import GaussianStateUpdate
from stonesoup.updater.kalman import ExtendedKalmanUpdater

from maasi_filter import AgentMeasurement, Pose, Sensor, make_filter
from maasi_filter.arrays import FloatArray
from maasi_filter.metrics import gospa
from maasi_filter.pmb.filter import PmbFilter
from maasi_sim.experiments.statistics import mean_interval
from maasi_sim.scenario.schema import Scenario
from maasi_sim.search import search

CUTOFF = 10.0
START = datetime.datetime(2026, 1, 1)
# Of what Stone Soup is told: the least clutter in a scan, as of `pmb`.
LEAST_CLUTTER = 0.05
# A track is deleted after this many expected detections in a row that did not come.
MOST_MISSES = 3.0
# Variance of static targets' walk in a second, square metres: Stone Soup needs one.
LEAST_WALK = 1e-6


@dataclass
class View:
    """The sensor and its pose at the scan that is processed."""

    sensor: Sensor
    pose: Pose

    def probability(self, state: Any) -> float:
        place = np.asarray(state.mean, float).reshape(1, 3)
        return min(float(self.sensor.detection.probability(place, self.pose)[0]), 0.999)


class ViewedHypothesiser(PDAHypothesiser):
    """Probabilistic data association that is told pi at each track."""

    view: View = Property(doc='Sensor and pose')

    def hypothesise(self, track: Any, detections: Any, timestamp: Any, **kwargs: Any) -> Any:
        self.prob_detect = Probability(max(self.view.probability(track.state), 1e-6))
        return super().hypothesise(track, detections, timestamp, **kwargs)


class MissedDeleter(Deleter):
    """Deletes a track whose detections were expected, and did not come."""

    view: View = Property(doc='Sensor and pose')

    def check_for_deletion(self, track: Any, **kwargs: Any) -> bool:
        """Count the expected detections that were missed."""
        missed = track.metadata.get('missed', 0.0)
        if isinstance(track.state, GaussianStateUpdate):
            missed = 0.0
        else:
            missed += self.view.probability(track.state)
        track.metadata['missed'] = missed
        return bool(missed > MOST_MISSES)


class StoneSoup:
    """A JPDA tracker with extended Kalman filters.

    `scan` is the first one, `bounds` (3, 2) those of the environment [m], `walk` the deviation of
    the targets' walk [m/sqrt(s)].
    """

    def __init__(self, scan: AgentMeasurement, bounds: FloatArray, walk: float) -> None:
        self.view = View(scan.sensor, scan.pose)
        space = scan.sensor.measurement_space(bounds)
        walks = [RandomWalk(max(walk**2, LEAST_WALK))] * 3
        predictor = ExtendedKalmanPredictor(CombinedLinearGaussianTransitionModel(walks))
        updater = ExtendedKalmanUpdater(None)
        hypothesiser = ViewedHypothesiser(
            predictor=predictor,
            updater=updater,
            clutter_spatial_density=max(scan.sensor.clutter, LEAST_CLUTTER / space),
            prob_gate=Probability(0.9999),
            view=self.view,
        )
        deleter = MissedDeleter(view=self.view)
        # A detection says where a target is on each axis: the prior is not used.
        initiator = MultiMeasurementInitiator(
            prior_state=GaussianState(np.zeros((3, 1)), np.eye(3)),
            deleter=deleter,
            data_associator=GNNWith2DAssignment(
                DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=4)
            ),
            updater=updater,
            min_points=2,
        )
        associator = JPDA(hypothesiser=hypothesiser)
        self.tracker = MultiTargetMixtureTracker(initiator, deleter, None, associator, updater)

    def step(self, scan: AgentMeasurement, seconds: float) -> None:
        self.view.sensor, self.view.pose = scan.sensor, scan.pose
        now = START + datetime.timedelta(seconds=seconds)
        # Stone Soup's order is elevation, bearing, range.
        order = [2, 1, 0]
        model = CartesianToElevationBearingRange(
            ndim_state=3,
            mapping=(0, 1, 2),
            noise_covar=CovarianceMatrix(scan.sensor.covariance[np.ix_(order, order)]),
            translation_offset=scan.pose.position.reshape(3, 1),
        )
        detections = {
            Detection(row[order].reshape(3, 1), timestamp=now, measurement_model=model)
            for row in np.asarray(scan.values)
        }
        self.tracker.detector_iter = iter([(now, detections)])
        next(self.tracker)

    def estimates(self) -> FloatArray:
        """Return the positions of the tracks, (n, 3), metres."""
        rows = [np.asarray(track.state.mean, float).ravel() for track in self.tracker.tracks]
        return np.array(rows).reshape(-1, 3)


def recorded(scenario: Scenario, seed: int) -> list[tuple[list[AgentMeasurement], int, float]]:
    """Return what a search with `pmb` measured: measurements, steps gone and time of each batch."""
    batches: list[tuple[list[AgentMeasurement], int, float]] = []
    true_step = PmbFilter.step

    def step(self: Any, measurements: Sequence[AgentMeasurement], gone: int, now: float) -> Any:
        batches.append((list(measurements), gone, now))
        return true_step(self, measurements, gone, now)

    with patch.object(PmbFilter, 'step', step):
        search(scenario, seed)
    return batches


def compare(scenario: Scenario, seed: int) -> FloatArray:
    """Return mean GOSPA, GOSPA at the end and time of a step [s], of both filters, (2, 3)."""
    batches = recorded(scenario, seed)
    bounds, world = scenario.environment.array(), scenario.world(seed)
    ours = make_filter(scenario.filter, bounds, np.random.default_rng(seed))
    theirs = StoneSoup(batches[0][0][0], bounds, scenario.filter.pmb.walk or 0.0)
    scores, times = np.zeros((2, len(batches))), np.zeros((2, len(batches)))
    for k, (measurements, gone, now) in enumerate(batches):
        begin = time.perf_counter()
        ours.step(measurements, gone, now)
        between = time.perf_counter()
        for measurement in measurements:
            theirs.step(measurement, now)
        times[:, k] = between - begin, time.perf_counter() - between
        positions = [target.position for target in ours.found_targets]
        positions += [cluster.position for cluster in ours.clusters if cluster.mass > 0.5]
        truth = world.targets_at(round(now / scenario.step))
        for row, estimate in enumerate((np.array(positions).reshape(-1, 3), theirs.estimates())):
            scores[row, k] = gospa(estimate, truth, CUTOFF).total
    return np.stack([scores.mean(axis=1), scores[:, -1], np.median(times, axis=1)], axis=1)


def print_table(
    conditions: Sequence[str],
    seeds: Sequence[int],
    prepare: Callable[[str, str, int], Scenario],
) -> None:
    """Print a table of both on the same detections; means with 95 % half widths."""
    print('| condition | runs | | mean GOSPA [m] | at the end [m] | step [ms] |')
    print('|---|---|---|---|---|---|')
    for name in conditions:
        every = [compare(prepare(name, 'pmb', seed), seed) for seed in seeds]
        for row, method in enumerate(('pmb', 'Stone Soup JPDA')):
            cells = [mean_interval([both[row, column] for both in every]) for column in range(3)]
            spans = [f'{cell.mean:.2f} ± {cell.half_width:.2f}' for cell in cells[:2]]
            print(
                f'| {name} | {len(seeds)} | {method} | {spans[0]} | {spans[1]} | '
                f'{1e3 * cells[2].mean:.1f} |',
                flush=True,
            )
