"""The multi-Bernoulli filter next to Stone Soup's JPDA tracker, on the same recorded detections."""

import datetime
import time
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

from maasi_filter import make_filter
from maasi_filter.metrics import gospa
from maasi_filter.pmb.filter import PmbFilter
from maasi_sim.experiments.statistics import mean_interval
from maasi_sim.search import search

HEAD = 'condition', 'runs', '', 'mean GOSPA [m]', 'at the end [m]', 'step [ms]'
CUTOFF = 10.0
ORDER = [2, 1, 0]  # elevation, bearing, range
START = datetime.datetime(2026, 1, 1)
# Setting of Stone Soup: the least clutter in a scan, as of `pmb`.
LEAST_CLUTTER = 0.05
# A track is deleted after this many expected detections in a row that did not come.
MOST_MISSES = 3.0
# Variance of static targets' walk in a second, square metres: Stone Soup needs one.
LEAST_WALK = 1e-6


def probability(scan, state):
    """Return pi at a track, by the sensor and its pose at the scan that is processed."""
    place = np.asarray(state.mean, float).reshape(1, 3)
    return min(float(scan.sensor.detection.probability(place, scan.pose)[0]), 0.999)


def detections_of(scan, now):
    """Return the detections of a scan, with the model of its sensor and pose."""
    model = CartesianToElevationBearingRange(
        ndim_state=3,
        mapping=(0, 1, 2),
        noise_covar=CovarianceMatrix(scan.sensor.covariance[np.ix_(ORDER, ORDER)]),
        translation_offset=scan.pose.position.reshape(3, 1),
    )
    return [
        Detection(row[ORDER].reshape(3, 1), timestamp=now, measurement_model=model)
        for row in np.asarray(scan.values)
    ]


class ViewedHypothesiser(PDAHypothesiser):
    """Data association with pi at each track: a constant deletes tracks out of view."""

    scan: Any = Property(doc='The scan that is processed')

    def hypothesise(self, track, detections, timestamp, **kwargs):
        self.prob_detect = Probability(max(probability(self.scan, track.state), 1e-6))
        return super().hypothesise(track, detections, timestamp, **kwargs)


class MissedDeleter(Deleter):
    """Deletes a track whose detections were expected, and did not come."""

    scan: Any = Property(doc='The scan that is processed')

    def check_for_deletion(self, track, **kwargs):
        """Count the expected detections that were missed."""
        missed = track.metadata.get('missed', 0.0) + probability(self.scan, track.state)
        track.metadata['missed'] = 0.0 if isinstance(track.state, GaussianStateUpdate) else missed
        return track.metadata['missed'] > MOST_MISSES


class StoneSoup:
    """A JPDA tracker with extended Kalman filters; `walk` is that of the targets [m/sqrt(s)]."""

    def __init__(self, scan, bounds, walk):
        walks = [RandomWalk(max(walk**2, LEAST_WALK))] * 3
        predictor = ExtendedKalmanPredictor(CombinedLinearGaussianTransitionModel(walks))
        updater = ExtendedKalmanUpdater(None)
        least = LEAST_CLUTTER / scan.sensor.measurement_space(bounds)
        self.hypothesiser = ViewedHypothesiser(
            predictor=predictor,
            updater=updater,
            clutter_spatial_density=max(scan.sensor.clutter, least),
            prob_gate=Probability(0.9999),
            scan=scan,
        )
        self.deleter = MissedDeleter(scan=scan)
        distance = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=4)
        # A detection says where a target is on each axis: the prior is not used.
        initiator = MultiMeasurementInitiator(
            prior_state=GaussianState(np.zeros((3, 1)), np.eye(3)),
            deleter=self.deleter,
            data_associator=GNNWith2DAssignment(distance),
            updater=updater,
            min_points=2,
        )
        associator = JPDA(hypothesiser=self.hypothesiser)
        self.tracker = MultiTargetMixtureTracker(initiator, self.deleter, None, associator, updater)

    def step(self, scan, seconds):
        self.hypothesiser.scan = self.deleter.scan = scan
        now = START + datetime.timedelta(seconds=seconds)
        detections = set(detections_of(scan, now))
        self.tracker.detector_iter = iter([(now, detections)])
        next(self.tracker)

    def estimates(self):
        return [np.asarray(track.state.mean, float).ravel() for track in self.tracker.tracks]


def compare(scenario, seed):
    """Return mean GOSPA, GOSPA at the end and time of a step [s], of both filters, (2, 3)."""
    with patch.object(PmbFilter, 'step', autospec=True, side_effect=PmbFilter.step) as step:
        search(scenario, seed)
    batches = [call.args[1:] for call in step.call_args_list]
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
        for row, estimate in enumerate((positions, theirs.estimates())):
            scores[row, k] = gospa(np.array(estimate).reshape(-1, 3), truth, CUTOFF).total
    return np.stack([scores.mean(axis=1), scores[:, -1], np.median(times, axis=1)], axis=1)


def rows(conditions, seeds, prepare):
    """Yield rows of both filters on the same detections; means with 95 % half widths."""
    for name in conditions:
        every = np.array([compare(prepare(name, 'pmb', seed), seed) for seed in seeds])
        for method, runs in zip(('pmb', 'Stone Soup JPDA'), every.transpose(1, 2, 0)):
            mean, end, step = map(mean_interval, runs)
            spans = [f'{cell.mean:.2f} ± {cell.half_width:.2f}' for cell in (mean, end)]
            yield name, str(len(seeds)), method, *spans, f'{1e3 * step.mean:.1f}'
