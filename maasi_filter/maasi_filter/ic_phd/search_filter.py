"""One step of the search filter for a set M_k of measuring robots."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_filter.exploration import Exploration, check_bounds
from maasi_filter.ic_phd import births as birth_models
from maasi_filter.ic_phd.clusters import Cluster, group_clusters, kmeans, kmeans_clusters
from maasi_filter.ic_phd.credits import Credit, credit_of, from_arrays, to_arrays
from maasi_filter.ic_phd.found_targets import (
    UNLIMITED_INFORMATION,
    FoundTarget,
    exclusive,
    extended_information,
    found_intensity,
    missing_spread,
    narrow_clouds,
    refine,
    remove_measurements,
)
from maasi_filter.ic_phd.particles import (
    clear,
    gather,
    group_moments,
    groups_of,
    jitter,
    resample,
    total_weight,
)
from maasi_filter.ic_phd.phd import MeasurementSet, Workspace, associate, prepare_measurements
from maasi_filter.ic_phd.state_check import check_exploration, check_state
from maasi_filter.ic_phd.unconfirmed_targets import LostTargets
from maasi_filter.ic_phd.undetected_births import missed_before
from maasi_filter.models.detection import BoxDetection, DetectionModel
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor, is_covariance
from maasi_filter.settings import FilterSettings
from maasi_filter.state_file import (
    StateFileError,
    generator_state,
    read_state,
    restored_generator,
    text,
    untext,
    write_state,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Threads only pay off for sets of this size.
PARALLEL_PARTICLES = 65_536
# Lengths that are not given, as multiples of the deviation of the range.
FOUND_RADIUS_DEVIATIONS = 2.0
JITTER_DEVIATIONS = 0.03
# A box's edge is as uncertain as the robot's position; so are its measurements.
POSE_ERROR_OF_BOX = 0.05
# Cells along the mean side of the environment, in 2D and 3D.
EXPLORATION_CELLS = {2: 54, 3: 13}
LEAST_CLUSTER_MASS = 0.1
# Two estimates whose difference is below this many deviations, squared, may be one target.
SAME_TARGET = 16.0
# Particles of a birth when there are more detections than there are particles for.
LEAST_BIRTHS = 20
# Draws of a birth where particles explain the detection.
LEAST_DRAWS = 32
# A share of an intensity that changes no sum; the kernels leave out particles of weight 0.
NEXT_TO_NOTHING = 1e-100
# Births that explain less of a detection than this are not worth their particles.
LEAST_BIRTH_MASS = 1e-3


@dataclass
class AgentMeasurement:
    """What one robot measured at one step; an empty one counts too.

    Parameters
    ----------
    robot : str
        Its name; robots are processed in the order of their names.
    pose : Pose
        Of the sensor at the time of the measurement.
    sensor : Sensor
        What it measured with.
    values : (m, d) array
        Detections: range, bearing and, in 3D, elevation; m, rad, rad.
    covariances : (m, d, d) array, optional
        Of each detection; they win over the sensor's, except in the `paper_*` presets.
    index : int
        That robot's measurement index.
    position_covariance : (3, 3) array, optional
        What the robot says of the error of its own position, square metres. Covariances of
        detections are taken to have it in them already.
    """

    robot: str
    pose: Pose
    sensor: Sensor
    values: FloatArray
    covariances: FloatArray | None = None
    index: int = 0
    position_covariance: FloatArray | None = None


@dataclass
class FilterResult:
    """What a step brought.

    Parameters
    ----------
    clusters : list of Cluster
        Potential targets after the step, found ones not among them.
    newly_found : list of FoundTarget
        Targets found in this step.
    found_changed : bool
        Whether any found target is new or has moved.
    expected_number : float
        Expected number of targets in the intensity; found ones not among them.
    dropped : dict
        Detections that were not used: reason to count.
    """

    clusters: list[Cluster]
    newly_found: list[FoundTarget]
    found_changed: bool
    expected_number: float
    dropped: dict[str, int] = field(default_factory=dict)


@dataclass
class _Member:
    """A checked measurement: every detection has a covariance, and their order is fixed.

    `own` tells whether the covariances are the detections' own; `pose_error` is the deviation of
    the error of the robot's position, per axis, as far as it is not in them.
    """

    robot: str
    pose: Pose
    sensor: Sensor
    values: FloatArray
    covariances: FloatArray
    own: bool
    index: int
    pose_error: float

    def only(self, keep: NDArray[np.bool_]) -> _Member:
        """Return a copy with some of the detections."""
        if keep.all():
            return self
        return replace(self, values=self.values[keep], covariances=self.covariances[keep])


class SearchFilter:
    """Particle PHD filter with an iterated corrector, births, extraction and found targets.

    Parameters
    ----------
    settings : FilterSettings
        What is left None comes from the preset, or is derived from the sensor that measures.
    bounds : (d, 2) array
        Of the environment E, metres; d = 2 or 3.
    generator : numpy.random.Generator
        Every random draw comes from it.

    Attributes
    ----------
    particles : (n, d) array
        Metres, frame `map`.
    weights : (n,) array
        They sum to the expected number of targets that are not found yet.
    found_targets : list of FoundTarget
        In the order of being found.
    clusters : list of Cluster
        Potential targets, heaviest first.
    exploration : Exploration
        e, updated with every measurement.
    """

    def __init__(
        self, settings: FilterSettings, bounds: ArrayLike, generator: np.random.Generator
    ) -> None:
        self.settings = settings
        self._numbers = settings.resolved()
        self.bounds = check_bounds(bounds)
        self.dimension = len(self.bounds)
        self.generator = generator
        size = self.bounds[:, 1] - self.bounds[:, 0]
        self.volume = float(np.prod(size))
        # Of a uniform density over the environment: enough to be never singular.
        self._prior_information: FloatArray = np.diag(12.0 / size**2)
        spacing = self._numbers.exploration_spacing
        if spacing is None:
            spacing = self.volume ** (1.0 / self.dimension) / EXPLORATION_CELLS[self.dimension]
        self.exploration = Exploration(self.bounds, spacing)
        self.particles: FloatArray = np.empty((0, self.dimension))
        self.weights: FloatArray = np.empty(0)
        self.found_targets: list[FoundTarget] = []
        self.clusters: list[Cluster] = []
        self._group: IntArray = np.empty(0, np.int64)
        self._groups = 0
        self._credits: list[Credit | None] = []
        # What the detections that a group explains tell about where it is.
        self._information: FloatArray = np.empty((0, self.dimension, self.dimension))
        self._places: FloatArray = np.empty((0, self.dimension))
        self._covariances: list[FloatArray] = []
        self._centres: FloatArray | None = None
        self._predicted: FloatArray | None = None
        # Who has measured in the present step already: 1 - pi of theirs is in D^{o-1} of (9).
        self._before: list[tuple[DetectionModel, Pose]] = []
        self._birth_budget = 0
        self._moments: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._expected: float | None = None
        self._lost = self._nothing_lost()
        self._workspace = Workspace()
        # How many particles are the same as at the last update of the present step.
        self._arranged = 0
        self._pool: ThreadPoolExecutor | None = None

    @property
    def expected_number(self) -> float:
        """Expected number of targets in the intensity, the mass of the particles."""
        return total_weight(self.weights)

    def _nothing_lost(self) -> LostTargets | None:
        """Return no lost targets; None where there never are any."""
        numbers = self._numbers
        # Only detections that last for good prove that there is a target.
        if numbers.extraction != 'measurement' or numbers.survival_probability != 1.0:
            return None
        assert numbers.expected_targets is not None
        intensity = numbers.expected_targets / self.volume
        return LostTargets(self.dimension, intensity, LEAST_CLUSTER_MASS)

    def restore_particles(
        self, particles: ArrayLike, weights: ArrayLike, group: ArrayLike | None = None
    ) -> None:
        """Put other particles in place of the present ones; detections so far are forgotten.

        Parameters
        ----------
        particles : (n, d) array
            Metres, frame `map`.
        weights : (n,) array
            Not negative.
        group : (n,) int array, optional
            Which of them belong together, from 0; all in one group if not given.

        Raises
        ------
        ValueError
            If shapes do not fit, or a number is not finite or negative.
        """
        positions = np.array(particles, dtype=float).reshape(-1, self.dimension)
        masses = np.array(weights, dtype=float)
        if masses.shape != (len(positions),):
            raise ValueError(f'weights: got shape {masses.shape}, allowed is ({len(positions)},)')
        if not (np.isfinite(positions).all() and np.isfinite(masses).all()):
            raise ValueError('particles, weights: got a number that is not finite')
        if (masses < 0.0).any():
            raise ValueError(f'weights: got {masses.min()}, allowed are numbers from 0')
        labels = np.zeros(len(positions), np.int64)
        if group is not None:
            labels = np.array(group, dtype=np.int64)
            if labels.shape != masses.shape or (len(labels) and labels.min() < 0):
                raise ValueError('group: allowed is a number from 0 for each particle')
        self.particles = np.ascontiguousarray(positions)
        self.weights = masses
        self._group = labels
        self._groups = int(labels.max()) + 1 if len(labels) else 0
        self._credits = [None] * self._groups
        # What they are known from is not known, so nothing is held against their spread.
        self._information = np.zeros((self._groups, self.dimension, self.dimension))
        self._information[:] = UNLIMITED_INFORMATION * np.eye(self.dimension)
        self._places = np.zeros((self._groups, self.dimension))
        self._lost = self._nothing_lost()

    # The state in a file.

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the whole state, random generator included, to one file.

        The file is replaced in one piece: a crash leaves the old one or the new one.
        """
        write_state(path, self.state())

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the whole state, random generator included, as arrays for a file."""
        targets = self.found_targets
        d = self.dimension
        state = {
            'settings': text(self.settings.model_dump_json(exclude_unset=True)),
            'generator': text(generator_state(self.generator)),
            'bounds': self.bounds,
            'spacing': np.array(self.exploration.spacing),
            'exploration': self.exploration.values,
            'particles': self.particles,
            'weights': self.weights,
            'group': self._group,
            'groups': np.array(self._groups),
            'information': self._information,
            'places': self._places,
            'centres': np.empty((0, d)) if self._centres is None else self._centres,
            'robots': text(json.dumps([target.robot for target in targets])),
            'found_ids': np.array([target.id for target in targets], np.int64),
            'found_measurements': np.array([target.measurement for target in targets], np.int64),
            'found_origins': np.array([target.origin for target in targets], np.int64),
            'found_times': np.array([target.time for target in targets], float),
            'found_positions': np.array([t.position for t in targets]).reshape(-1, d),
            'found_covariances': np.array([t.covariance for t in targets]).reshape(-1, d, d),
            'own_covariances': np.array(self._covariances).reshape(-1, d, d),
            'cluster_positions': np.array([c.position for c in self.clusters]).reshape(-1, d),
            'cluster_covariances': np.array([c.covariance for c in self.clusters]).reshape(
                -1, d, d
            ),
            'cluster_radii': np.array([c.radius for c in self.clusters], float),
            'cluster_masses': np.array([c.mass for c in self.clusters], float),
        }
        state.update(to_arrays(self._credits))
        if self._lost is not None:
            state.update(self._lost.arrays())
        return state

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SearchFilter:
        """Return the filter that was saved; it continues to the bit as the saved one would have.

        Raises
        ------
        StateFileError
            If the file is missing, of another format or version, or damaged; it says which.
        """
        return cls.from_state(read_state(path), path)

    @classmethod
    def from_state(
        cls, state: Mapping[str, NDArray[Any]], path: str | os.PathLike[str]
    ) -> SearchFilter:
        """Return the filter of a state; `path` is named in errors.

        Raises
        ------
        StateFileError
            If an array is missing, or has a wrong shape or number.
        """
        try:
            check_state(state)
            search = cls(
                FilterSettings.model_validate_json(untext(state['settings'])),
                state['bounds'],
                restored_generator(untext(state['generator'])),
            )
            search.exploration = Exploration(search.bounds, float(state['spacing']))
            check_exploration(state['exploration'], search.exploration.values.shape)
            search.exploration.values[...] = state['exploration']
            search.particles = state['particles']
            search.weights = state['weights']
            search._group = state['group']
            search._groups = int(state['groups'])
            search._credits = from_arrays(state)
            search._information = state['information']
            search._places = state['places']
            search._centres = state['centres'] if len(state['centres']) else None
            search._covariances = list(state['own_covariances'])
            search.found_targets = [
                FoundTarget(
                    int(number), position, covariance, robot, int(index), float(time), int(origin)
                )
                for number, position, covariance, robot, index, time, origin in zip(
                    state['found_ids'],
                    state['found_positions'],
                    state['found_covariances'],
                    _names(untext(state['robots']), len(state['found_ids'])),
                    state['found_measurements'],
                    state['found_times'],
                    state['found_origins'],
                )
            ]
            search.clusters = [
                Cluster(position, covariance, float(radius), float(mass))
                for position, covariance, radius, mass in zip(
                    state['cluster_positions'],
                    state['cluster_covariances'],
                    state['cluster_radii'],
                    state['cluster_masses'],
                )
            ]
            if search._lost is not None:
                search._lost.restore(dict(state))
        except KeyError as error:
            raise StateFileError(f'{path}: does not hold a usable state: no {error}') from None
        except (ValueError, TypeError) as error:
            raise StateFileError(f'{path}: does not hold a usable state: {error}') from None
        return search

    # What the settings leave to the sensor.

    def _pose_error(self, sensor: Sensor) -> float:
        """Return the error of a robot's position, where it does not say more of it."""
        if self._numbers.pose_error is not None:
            return self._numbers.pose_error
        if isinstance(sensor.detection, BoxDetection):
            extent = sensor.detection.upper - sensor.detection.lower
            return POSE_ERROR_OF_BOX * 0.5 * float(extent[: self.dimension].min())
        return 0.0

    def _found_radius(self, sensor: Sensor) -> float:
        if self._numbers.found_radius is not None:
            return self._numbers.found_radius
        return FOUND_RADIUS_DEVIATIONS * math.sqrt(
            sensor.covariance[0, 0] + self._pose_error(sensor) ** 2
        )

    def _jitter_deviation(self, sensor: Sensor) -> float:
        if self._numbers.jitter_deviation is not None:
            return self._numbers.jitter_deviation
        return JITTER_DEVIATIONS * math.sqrt(sensor.covariance[0, 0])

    def _detection(self, member: _Member) -> DetectionModel:
        """Return pi as the filter has it: a box's edge is softened by the pose's error."""
        detection = member.sensor.detection
        if isinstance(detection, BoxDetection):
            return detection.softened(2.0 * member.pose_error)
        return detection

    # One step.

    def step(
        self, measurements: Sequence[AgentMeasurement], steps: int, time: float
    ) -> FilterResult:
        """Predict over `steps` control steps, correct with every robot of M_k, extract and mark.

        Parameters
        ----------
        measurements : sequence of AgentMeasurement
            M_k, in any order; they are processed in the order of the robots' names. May be empty.
        steps : int
            Control steps since the last batch, from 0.
        time : float
            Seconds, kept with what is found.

        Raises
        ------
        ValueError
            If anything is not finite, a covariance is not positive definite, shapes or dimensions
            do not fit, or a robot is there twice. Nothing has changed then.
        """
        if isinstance(steps, bool) or int(steps) != steps or steps < 0:
            raise ValueError(f'steps: got {steps!r}, allowed are whole numbers from 0')
        if not math.isfinite(time):
            raise ValueError(f'time: got {time}, allowed are finite numbers')
        self._moments = None
        self._expected = None
        members = [self._checked(m) for m in sorted(measurements, key=lambda m: m.robot)]
        names = [member.robot for member in members]
        if len(set(names)) != len(names):
            raise ValueError(f'measurements: got robots {names}, allowed is each robot once')
        numbers = self._numbers
        survival = numbers.survival_probability
        assert survival is not None
        if survival < 1.0:
            self.weights = self.weights * survival ** int(steps)
        dropped: dict[str, int] = {}
        newly_found: list[FoundTarget] = []
        moved = False
        detections = 0
        if numbers.removal in ('closest', 'every'):
            members = [self._without_found(member, dropped) for member in members]
        if numbers.births != 'measurement':
            self._add_births(members)
        self._predicted = self.weights.copy() if numbers.corrector == 'predicted' else None
        total = sum(len(member.values) for member in members)
        self._birth_budget = numbers.particles // (2 * max(total, 1))
        self._arranged = 0
        self._before = []
        for member in members:
            used, refined = self._correct(member, newly_found, dropped, time)
            self._before.append((self._detection(member), member.pose))
            detections += used
            moved |= refined
        self._predicted = None
        if detections:
            self._resample(members)
        else:
            # What the workspace holds is overwritten by the next step.
            self.particles = self._workspace.released(self.particles)
            self.weights = self._workspace.released(self.weights)
            self._group = self._workspace.released(self._group)
        if numbers.extraction == 'kmeans':
            self._extract_kmeans(members, newly_found, time)
        else:
            self._extract_groups(members)
        return FilterResult(
            clusters=list(self.clusters),
            newly_found=newly_found,
            found_changed=moved or bool(newly_found),
            expected_number=self.expected_number if self._expected is None else self._expected,
            dropped=dropped,
        )

    # What the filters of other robots have found.

    def take_over(self, robot: str, targets: Sequence[FoundTarget]) -> bool:
        """Take over what the filter of another robot has found; return whether anything changed.

        The independent robots of 002, section 4, share their found targets: detections of them
        are no news to anybody any more. A target that two robots found belongs to the one that
        was first, at the same time to the first by name, and follows that one's estimate.

        Parameters
        ----------
        robot : str
            Whose filter.
        targets : sequence of FoundTarget
            All that its filter found itself, as they stand there; taken before `step`.

        Raises
        ------
        ValueError
            If a number is not finite, or dimensions do not fit. Nothing has changed then.
        """
        d = self.dimension
        for target in targets:
            if target.position.shape != (d,) or target.covariance.shape != (d, d):
                raise ValueError(
                    f'{robot}: target {target.id}: got {len(target.position)} dimensions, allowed '
                    f'is {d}'
                )
            if not (np.isfinite(target.position).all() and is_covariance(target.covariance)):
                raise ValueError(
                    f'{robot}: target {target.id}: got position {target.position.tolist()} with '
                    f'covariance {target.covariance.tolist()}, allowed are finite numbers and a '
                    'positive definite matrix'
                )
        places = {(item.robot, item.origin): f for f, item in enumerate(self.found_targets)}
        changed = False
        for target in targets:
            f = places.get((robot, target.id), -1)
            if f < 0:
                f = self._known_as(target)
                if f >= 0:
                    known = self.found_targets[f]
                    if (known.time, known.robot) <= (target.time, robot):
                        continue
            number = self.found_targets[f].id if f >= 0 else self._next_id()
            taken = FoundTarget(
                number,
                target.position.copy(),
                target.covariance.copy(),
                robot,
                target.measurement,
                target.time,
                target.id,
            )
            if f < 0:
                self.found_targets.append(taken)
                self._covariances.append(taken.covariance)
                self._forget(taken)
            elif _same_estimate(taken, self.found_targets[f]):
                continue
            else:
                self.found_targets[f] = taken
                self._covariances[f] = taken.covariance
            changed = True
        return changed

    def keep_found(self, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Add targets that were found before this filter was made; return those that are new.

        They keep their ids. Where another target has such an id already, the next free one is
        used.

        Parameters
        ----------
        targets : sequence of FoundTarget
            With finite positions and covariances of this dimension.
        """
        own = {target.id: target for target in self.found_targets}
        kept = {target.id for target in targets}
        since = [target for target in self.found_targets if target.id not in kept]
        new: list[FoundTarget] = []
        for target in targets:
            same_id = [own[target.id]] if target.id in own else []
            if any(_distance(target, known) < SAME_TARGET for known in same_id or since):
                continue
            added = replace(target, id=self._next_id() if same_id else target.id)
            self.found_targets.append(added)
            self._covariances.append(added.covariance)
            self._forget(added)
            new.append(added)
        return new

    def _next_id(self) -> int:
        return 1 + max((target.id for target in self.found_targets), default=0)

    def own_found_targets(self) -> list[FoundTarget]:
        """Return the found targets that this filter found itself."""
        return [target for target in self.found_targets if not target.origin]

    def _known_as(self, target: FoundTarget) -> int:
        """Return the nearest found target that may be the same, or -1."""
        best, nearest = -1, SAME_TARGET
        for f, known in enumerate(self.found_targets):
            distance = _distance(target, known)
            if distance < nearest:
                best, nearest = f, distance
        return best

    def _forget(self, target: FoundTarget) -> None:
        """Delete the particles that a target explains: the nearest group, if it may be it."""
        if not len(self.weights):
            return
        mass, means, covariances = group_moments(
            self.particles, self.weights, self._group, self._groups, self._threads()
        )
        best, nearest = -1, SAME_TARGET
        for g in np.flatnonzero(mass > 0.0).tolist():
            offset = means[g] - target.position
            total = covariances[g] + target.covariance
            distance = float(offset @ np.linalg.solve(total, offset))
            if distance < nearest:
                best, nearest = g, distance
        offset = self.particles - target.position
        spread = math.sqrt(float(np.trace(target.covariance)))
        keep = (np.sqrt((offset * offset).sum(axis=1)) > 3.0 * spread) & (self._group != best)
        present, group = np.unique(self._group[keep], return_inverse=True)
        self.particles = self.particles[keep]
        self.weights = self.weights[keep]
        self._group = group.astype(np.int64).reshape(-1)
        self._groups = len(present)
        self._credits = [self._credits[g] for g in present.tolist()]
        self._information = self._information[present]
        self._places = self._places[present]

    def _checked(self, measurement: AgentMeasurement) -> _Member:
        """Return a measurement whose arrays fit, its detections in a fixed order."""
        name = measurement.robot
        d = self.dimension
        if measurement.sensor.dimension != d:
            raise ValueError(
                f'{name}: sensor: got {measurement.sensor.dimension} dimensions, allowed is {d}'
            )
        values = np.array(measurement.values, dtype=float)
        if values.size == 0:
            values = values.reshape(0, d)
        if values.ndim != 2 or values.shape[1] != d:
            raise ValueError(f'{name}: values: got shape {values.shape}, allowed is (m, {d})')
        if not np.isfinite(values).all():
            raise ValueError(f'{name}: values: got {values.tolist()}, allowed are finite numbers')
        own = False
        if self._numbers.use_detection_covariances and measurement.covariances is not None:
            own = True
            covariances = np.array(measurement.covariances, dtype=float)
            if covariances.size == 0:
                covariances = covariances.reshape(0, d, d)
            if covariances.shape != (len(values), d, d):
                raise ValueError(
                    f'{name}: covariances: got shape {covariances.shape}, '
                    f'allowed is ({len(values)}, {d}, {d})'
                )
            for covariance in covariances:
                if not is_covariance(covariance):
                    raise ValueError(
                        f'{name}: covariances: got {covariance.tolist()}, allowed is a symmetric '
                        'positive definite matrix of finite numbers'
                    )
        else:
            covariances = np.empty((len(values), d, d))
            covariances[:] = measurement.sensor.covariance
        pose_error = self._pose_error(measurement.sensor)
        reported = measurement.position_covariance
        if reported is not None:
            variances = np.diagonal(np.asarray(reported, dtype=float))
            if variances.shape != (3,) or not (
                np.isfinite(variances).all() and min(variances) >= 0
            ):
                raise ValueError(
                    f'{name}: position_covariance: got {np.asarray(reported).tolist()}, allowed is '
                    'a (3, 3) matrix with finite variances from 0'
                )
            if self._numbers.pose_error is None and not own:
                pose_error = max(pose_error, math.sqrt(float(variances[:d].max())))
        # The order in which a sensor lists its detections means nothing, so it decides nothing.
        order = np.lexsort(values.T[::-1])
        return _Member(
            name,
            measurement.pose,
            measurement.sensor,
            values[order],
            covariances[order],
            own,
            measurement.index,
            pose_error,
        )

    def _without_found(self, member: _Member, dropped: dict[str, int]) -> _Member:
        """Return a member without the detections that found targets take (000, section 3.3)."""
        numbers = self._numbers
        if not self.found_targets:
            return member
        centres = member.sensor.measurement.inverse(member.values, member.pose)
        positions = np.array([target.position for target in self.found_targets])
        assert numbers.removal_distance is not None
        keep = remove_measurements(
            centres, positions, numbers.removal_distance, numbers.removal == 'every'
        )
        _count(dropped, 'found', int((~keep).sum()))
        return member.only(keep)

    def _add_births(self, members: Sequence[_Member]) -> None:
        """Add births that do not belong to one measurement: anywhere, or 003's Gaussian."""
        numbers = self._numbers
        if not members:
            return
        assert numbers.birth_targets is not None and numbers.birth_particles is not None
        if numbers.births == 'uniform':
            particles, weights = birth_models.uniform_births(
                self.bounds, numbers.birth_targets, numbers.birth_particles, self.generator
            )
        else:
            sets = [self._prepared(member) for member in members if len(member.values)]
            if not sets:
                return
            centres = np.concatenate([prepared.centres for prepared in sets])
            spread = np.zeros((self.dimension, self.dimension))
            for member, prepared in zip([m for m in members if len(m.values)], sets):
                for m in range(len(prepared)):
                    spread += _cartesian_noise(member, prepared, m)
            particles, weights = birth_models.gaussian_births(
                centres,
                spread / len(centres),
                self.bounds,
                numbers.birth_targets,
                numbers.birth_particles,
                self.generator,
            )
        if self._groups == 0:
            self._credits = [None]
            self._information = np.zeros((1, self.dimension, self.dimension))
            self._places = np.zeros((1, self.dimension))
        self._append(particles, weights, np.zeros(len(particles), np.int64), max(self._groups, 1))

    def _append(
        self, particles: FloatArray, weights: FloatArray, group: IntArray, groups: int
    ) -> None:
        space = self._workspace
        self.particles = space.extended('particles', self.particles, particles)
        self.weights = space.extended('weights', self.weights, weights)
        self._group = space.extended('group', self._group, group)
        if self._predicted is not None:
            # <psi, Y> of a later robot is the sum over the births at its own detections.
            nothing = NEXT_TO_NOTHING * weights
            self._predicted = np.concatenate([self._predicted, nothing])
        self._groups = groups

    def _append_born(
        self, born: birth_models.MeasurementBirths, scale: FloatArray, groups: int
    ) -> None:
        """Add births with their posterior weights b / C(z), where they are worth having."""
        per_target = self._numbers.particles_per_target
        assert per_target is not None
        mass, number, total = birth_models.births_worth_keeping(
            born, scale, per_target, LEAST_BIRTH_MASS
        )
        if total == 0:
            return
        self._append(
            *birth_models.thin_births(born, mass, number, total, groups, self.generator),
            self._groups,
        )

    def _prepared(self, member: _Member) -> MeasurementSet:
        return prepare_measurements(
            member.values,
            member.covariances,
            member.pose,
            member.pose_error,
            cartesian_near=member.own,
            cap_angles=self._numbers.births == 'measurement',
        )

    def _threads(self) -> ThreadPoolExecutor | None:
        if len(self.weights) < PARALLEL_PARTICLES:
            return None
        threads = self._numbers.threads or os.cpu_count() or 1
        if threads < 2:
            return None
        if self._pool is None:
            self._pool = ThreadPoolExecutor(threads)
        return self._pool

    def _correct(
        self,
        member: _Member,
        newly_found: list[FoundTarget],
        dropped: dict[str, int],
        time: float,
    ) -> tuple[int, bool]:
        """Correct with one robot's detections; return how many were used, and if any target moved.

        000, eq. (16), with the intensity of found targets and of unseen ones in C(z).
        """
        numbers = self._numbers
        sensor = member.sensor
        detection = self._detection(member)
        if math.isfinite(sensor.maximum_range):
            reach = member.values[:, 0] <= sensor.maximum_range
            _count(dropped, 'range', int((~reach).sum()))
            member = member.only(reach)
        count = len(member.values)
        if count == 0:
            missed = 1.0 - detection.probability(self.particles, member.pose)
            self.weights = self.weights * missed
            self.exploration.update(detection, member.pose)
            return 0, False
        prepared = self._prepared(member)
        born = None
        kappa = np.zeros((0, count))
        numerators: birth_models.MeasurementBirths | None = None

        def other(log_own: FloatArray) -> FloatArray:
            """Return what else explains each detection, once it is known what particles do."""
            nonlocal born, kappa, numerators
            intensity = np.full(count, sensor.clutter)
            if numbers.births == 'measurement':
                born = self._births(member, detection, prepared, log_own)
                numerators = born
                if numbers.birth_prior == 'constant' and self._before:
                    numerators = missed_before(born, self._before)
                    born = born if self._predicted is not None else numerators
                intensity += born.totals
            if numbers.removal == 'soft' and self.found_targets:
                kappa = self._found_intensity(member, detection, prepared, intensity)
                intensity += kappa.sum(axis=0)
            return intensity

        kernel = detection.kernel()
        update = associate(
            self.particles,
            self.weights,
            detection.probability(self.particles, member.pose) if kernel is None else kernel,
            prepared,
            member.pose,
            other,
            denominator_weights=self._predicted,
            group=self._group,
            groups=self._groups,
            pool=self._threads(),
            workspace=self._workspace,
            known=self._arranged,
        )
        self._arranged = len(self.particles)
        explained = np.isfinite(update.log_normaliser)
        used = int(np.count_nonzero(explained))
        if used < count:
            self._count_unexplained(prepared, ~explained, dropped)
        if self._lost is not None and used:
            self._lost.add(prepared, explained, member.pose, detection, sensor.clutter)
        groups = self._groups
        self.weights = update.weights
        self._group = update.group
        self._groups = groups + count
        credit = Credit(member.robot, member.index, self._found_radius(sensor))
        self._credits = [*self._credits, *[credit] * count]
        self._information, self._places = extended_information(
            self._information,
            self._places,
            update.means,
            update.group_share,
            update.own_mass,
            prepared,
            member.pose,
        )
        if numerators is not None:
            self._append_born(numerators, update.other_scale, groups)
        moved = False
        claims = kappa * update.other_scale if len(kappa) else kappa
        if numbers.refine_found and len(claims):
            moved = self._refine(member, prepared, claims)
        if numbers.extraction == 'measurement':
            self._mark(
                member,
                update.own_mass,
                update.means,
                update.covariances,
                claims,
                groups,
                newly_found,
                time,
            )
        self.exploration.update(detection, member.pose)
        return used, moved

    def _births(
        self,
        member: _Member,
        detection: DetectionModel,
        prepared: MeasurementSet,
        log_own: FloatArray,
    ) -> birth_models.MeasurementBirths:
        numbers = self._numbers
        assert numbers.birth_particles is not None and numbers.expected_targets is not None
        assert numbers.particles_per_target is not None
        number = birth_models.births_worth_drawing(
            prepared,
            log_own,
            numbers.expected_targets,
            self.volume,
            numbers.particles_per_target,
            LEAST_DRAWS,
            max(LEAST_BIRTHS, min(numbers.birth_particles, self._birth_budget)),
        )
        return birth_models.measurement_births(
            prepared,
            member.pose,
            detection,
            self.exploration,
            numbers.expected_targets,
            number,
            self.generator,
            unexplored=numbers.birth_prior == 'unexplored',
        )

    def _count_unexplained(
        self,
        prepared: MeasurementSet,
        unexplained: NDArray[np.bool_],
        dropped: dict[str, int],
    ) -> None:
        centres = prepared.centres[unexplained]
        inside = ((centres >= self.bounds[:, 0]) & (centres <= self.bounds[:, 1])).all(axis=1)
        _count(dropped, 'outside', int((~inside).sum()))
        _count(dropped, 'unseen', int(inside.sum()))

    def _found_intensity(
        self,
        member: _Member,
        detection: DetectionModel,
        prepared: MeasurementSet,
        other: FloatArray,
    ) -> FloatArray:
        positions = np.array([target.position for target in self.found_targets])
        covariances = np.array([target.covariance for target in self.found_targets])
        probability = detection.probability(
            np.concatenate([positions, prepared.centres]), member.pose
        )
        kappa = found_intensity(
            positions,
            covariances,
            probability[: len(positions)],
            probability[len(positions) :],
            prepared,
            member.pose,
        )
        return exclusive(kappa, other)

    def _refine(self, member: _Member, prepared: MeasurementSet, claims: FloatArray) -> bool:
        """Update found targets with the detections that most probably are theirs."""
        moved = False
        best = claims.argmax(axis=1).tolist()
        for f, target in enumerate(self.found_targets):
            # What another robot found is its to refine.
            if target.origin or claims[f, best[f]] <= 0.5:
                continue
            position, covariance = refine(
                target.position, self._covariances[f], prepared, best[f], member.pose
            )
            if not (np.isfinite(position).all() and np.isfinite(covariance).all()):
                continue
            position = np.clip(position, self.bounds[:, 0], self.bounds[:, 1])
            self._covariances[f] = covariance
            self.found_targets[f] = FoundTarget(
                target.id,
                position,
                covariance + member.pose_error**2 * np.eye(self.dimension),
                target.robot,
                target.measurement,
                target.time,
            )
            moved = True
        return moved

    def _mark(
        self,
        member: _Member,
        own_mass: FloatArray,
        means: FloatArray,
        covariances: FloatArray,
        claims: FloatArray,
        groups: int,
        newly_found: list[FoundTarget],
        time: float,
    ) -> None:
        """Mark what detections pinned down: narrow, and known before this measurement."""
        numbers = self._numbers
        assert numbers.found_mass is not None
        radius = self._found_radius(member.sensor)
        known = len(claims)
        candidates, bounded = narrow_clouds(
            own_mass,
            covariances,
            self._information[groups : groups + len(own_mass)],
            self._prior_information,
            numbers.found_mass,
            radius,
        )
        for m in candidates.tolist():
            covariance = bounded[m]
            spread = math.sqrt(float(np.trace(covariance)))
            if self._is_known(means[m], covariance, claims, known, m):
                continue
            target = FoundTarget(
                self._next_id(),
                means[m].copy(),
                covariance + member.pose_error**2 * np.eye(self.dimension),
                member.robot,
                member.index,
                time,
            )
            self.found_targets.append(target)
            self._covariances.append(covariance)
            newly_found.append(target)
            # What another detection explains is another target's, however near.
            clear(
                self.particles,
                self.weights,
                self._group,
                means[m],
                3.0 * spread,
                groups + m,
                groups,
                self._threads(),
            )

    def _is_known(
        self,
        position: FloatArray,
        covariance: FloatArray,
        claims: FloatArray,
        known: int,
        measurement: int,
    ) -> bool:
        """Return whether a candidate may be a found target that this scan has not seen elsewhere.

        A target causes one detection of a scan at most, so a found target that surely caused
        another one is not this one.
        """
        for f in range(known):
            others = np.delete(claims[f], measurement)
            if len(others) and others.max() > 0.5:
                continue
            target = self.found_targets[f]
            offset = position - target.position
            total = covariance + target.covariance
            if float(offset @ np.linalg.solve(total, offset)) < SAME_TARGET:
                return True
        return False

    def _resample(self, members: Sequence[_Member]) -> None:
        numbers = self._numbers
        pool = self._threads()
        expected = total_weight(self.weights, pool)
        if not expected > 1e-12:
            self.particles = np.empty((0, self.dimension))
            self.weights = np.empty(0)
            self._group = np.empty(0, np.int64)
            self._groups = 0
            self._credits = []
            self._information = np.empty((0, self.dimension, self.dimension))
            self._places = np.empty((0, self.dimension))
            self._expected = 0.0
            return
        assert numbers.particles_per_target is not None and numbers.particles_minimum is not None
        wanted = max(numbers.particles_minimum, math.ceil(numbers.particles_per_target * expected))
        number = min(max(wanted, 1), numbers.particles)
        assert numbers.resampling is not None
        index = resample(self.weights, number, numbers.resampling, self.generator, pool)
        particles, copy, starts, present = gather(
            index, self.particles, self._group, self._groups, pool, self._workspace
        )
        group = groups_of(starts, pool)
        self._groups = len(starts) - 1
        self._credits = [self._credits[g] for g in np.flatnonzero(present).tolist()]
        self._information = self._information[present]
        self._places = self._places[present]
        weights = np.full(number, expected / number)
        mass, means, covariances = group_moments(particles, weights, group, self._groups, pool)
        # Resampling leaves few ancestors where the noise is narrow; their spread is no posterior.
        fill = None
        if numbers.extraction == 'measurement':
            fill = missing_spread(covariances, self._information, self._prior_information)
        assert numbers.jitter_differential is not None
        # Births that no detection has drawn together have nothing in common.
        known = self._information[:, 0, 0] > 0.0
        deviation = max((self._jitter_deviation(member.sensor) for member in members), default=0.0)
        if numbers.jitter_differential > 0.0 or deviation > 0.0:
            self.particles = jitter(
                particles,
                copy,
                starts,
                means,
                np.where(known, numbers.jitter_differential, 0.0),
                deviation,
                self.bounds,
                self.generator,
                fill=fill,
                pool=pool,
            )
        else:
            self.particles = particles.copy()
        self.weights = weights
        self._expected = expected
        self._group = group
        if fill is not None:
            covariances = covariances + fill @ fill.transpose(0, 2, 1)
        self._moments = mass, means, covariances

    def _extract_groups(self, members: Sequence[_Member]) -> None:
        least = min((self._found_radius(member.sensor) for member in members), default=0.0)
        self.clusters = []
        if self._groups and len(self.weights):
            if self._moments is None:
                self._moments = group_moments(
                    self.particles, self.weights, self._group, self._groups, self._threads()
                )
            self.clusters = group_clusters(*self._moments, LEAST_CLUSTER_MASS, least)
        if self._lost is not None and len(self._lost) and (not self.clusters or self._lost.crowded):
            d = self.dimension
            found = self.found_targets
            lost = self._lost.clusters(
                np.array([target.position for target in found]).reshape(-1, d),
                np.array([target.covariance for target in found]).reshape(-1, d, d),
                self.exploration,
                least,
            )
            # While particles stand for potential targets, detections may be theirs.
            self.clusters = self.clusters or lost

    def _extract_kmeans(
        self, members: Sequence[_Member], newly_found: list[FoundTarget], time: float
    ) -> None:
        """K-means with k the rounded expected number, and marking (000, section 3.3)."""
        numbers = self._numbers
        expected = self.expected_number
        if len(self.weights) == 0 or not expected > 0.0 or not members:
            self.clusters = [] if len(self.weights) == 0 else self.clusters
            return
        count = max(1, round(expected))
        assert numbers.kmeans_iterations is not None and numbers.found_mass is not None
        label, centres = kmeans(
            self.particles,
            self.weights,
            count,
            self.generator,
            self._centres,
            numbers.kmeans_iterations,
        )
        largest = numbers.found_radius_kind == 'maximum'
        clusters, labels = kmeans_clusters(
            self.particles, self.weights, label, len(centres), largest
        )
        last = members[-1]
        otherwise = Credit(last.robot, last.index, self._found_radius(last.sensor))
        remaining = []
        alive = np.ones(len(self.weights), np.bool_)
        kept = []
        for cluster, number in zip(clusters, labels):
            own = label == number
            credit = credit_of(self.weights[own], self._group[own], self._credits, otherwise)
            if cluster.radius <= credit.found_radius and cluster.mass >= numbers.found_mass:
                target = FoundTarget(
                    self._next_id(),
                    cluster.position,
                    cluster.covariance,
                    credit.robot,
                    credit.measurement,
                    time,
                )
                self.found_targets.append(target)
                self._covariances.append(cluster.covariance)
                newly_found.append(target)
                alive &= ~own
            else:
                remaining.append(cluster)
                kept.append(centres[number])
        if not alive.all():
            self.particles = self.particles[alive]
            self.weights = self.weights[alive]
            self._group = self._group[alive]
        self._centres = np.array(kept) if kept else None
        self.clusters = sorted(remaining, key=lambda cluster: -cluster.mass)


def _names(content: str, number: int) -> list[str]:
    """Return the robots' names in a state: JSON, one for each found target."""
    names = json.loads(content)
    valid = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not valid or len(names) != number:
        raise ValueError(f'robots: got {content[:100]}, allowed are {number} names')
    return list(names)


def _distance(one: FoundTarget, other: FoundTarget) -> float:
    """Return the squared normalised distance of two estimates."""
    offset = one.position - other.position
    return float(offset @ np.linalg.solve(one.covariance + other.covariance, offset))


def _same_estimate(one: FoundTarget, other: FoundTarget) -> bool:
    return (
        one.origin == other.origin
        and one.robot == other.robot
        and np.array_equal(one.position, other.position)
        and np.array_equal(one.covariance, other.covariance)
    )


def _count(dropped: dict[str, int], reason: str, number: int) -> None:
    if number:
        dropped[reason] = dropped.get(reason, 0) + number


def _cartesian_noise(member: _Member, prepared: MeasurementSet, index: int) -> FloatArray:
    """Return the noise of one detection as a covariance in metres."""
    root = prepared.roots[index]
    noise = (root[:, None, :] * root[None, :, :]).sum(axis=-1)
    if prepared.cartesian[index]:
        return np.asarray(noise)
    centre = prepared.centres[index : index + 1]
    jacobian = member.sensor.measurement.jacobian(centre, member.pose)[0]
    inverse = np.linalg.pinv(jacobian)
    return np.asarray(inverse @ noise @ inverse.T)
