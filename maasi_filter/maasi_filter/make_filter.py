"""Creates, loads and compiles the filter that the settings name."""

import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import TypeAdapter

from maasi_filter.arrays import ByteArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_filter.pmb.association import MANY_PAIRS, associate
from maasi_filter.pmb.component import gaps_of
from maasi_filter.records import AgentMeasurement
from maasi_filter.search_filter import SearchFilter
from maasi_filter.settings import (
    FILTERS,
    DetectionSettings,
    FilterSettings,
    NoiseSettings,
    SensorSettings,
)
from maasi_filter.state_file import StateFileError, read_state
from maasi_filter.unexplored_map import UnexploredMap


def make_filter(
    settings: FilterSettings, area: Area | ArrayLike, generator: np.random.Generator
) -> SearchFilter:
    """Return a new filter of the method that the settings name.

    Parameters
    ----------
    settings : FilterSettings
        Method and its parameters.
    area : Area or (d, 2) array
        Search area, or its bounds in metres; d = 2 or 3.
    generator : numpy.random.Generator
        Source of every random draw.

    Raises
    ------
    ValueError
        If the bounds or the spacing of the exploration grid are invalid.
    """
    kind: type[SearchFilter] = FILTERS.load(settings.method)
    return kind(settings, area, generator)


@dataclass
class Progress:
    """Progress of a run after a batch, saved with the filter."""

    batch: int = 0  # id of the last batch
    stamp: int = -1  # of the last batch [ns]
    step: int | None = None  # of the last batch, or of a later separate measurement
    #: Id of the batch that completed each found target, by its id.
    settled_by: dict[int, int] = field(default_factory=dict)
    #: Last received batch, measurement and stamp [ns], by robot.
    heard: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    #: The last update, serialised; it may not have been sent yet.
    update: ByteArray = field(default_factory=lambda: np.empty(0, np.uint8))


def load_filter(path: str | os.PathLike[str]) -> SearchFilter:
    """Return a saved filter, which continues bit for bit.

    Parameters
    ----------
    path : str or path
        File that `SearchFilter.save` wrote.

    Raises
    ------
    StateFileError
        If the file is missing, damaged, or of another format or version.
    """
    return load_state(path)[0]


def load_state(path: str | os.PathLike[str]) -> tuple[SearchFilter, Progress | None]:
    """Return the saved filter, and the progress of its run if it was saved."""
    saved = read_state(path)
    try:
        progress = TypeAdapter[Any](Progress | None).validate_python(saved.pop('progress', None))
        ((method, state),) = saved.items()
        kind: type[SearchFilter] = FILTERS.load(method)
        return kind.of(state), progress
    except (ValueError, KeyError) as error:
        raise StateFileError(f'{path}: does not hold a usable state: {error}') from None


def warm_up(method: str | None = None) -> None:
    """Compile every kernel of a step, or load it from the cache, for one method or for both."""
    for dimension in (2, 3):
        bounds = np.array([[0.0, 10.0]] * dimension)
        for detection in (
            DetectionSettings(kind='exponential', size=[5.0] * dimension),
            DetectionSettings(kind='box', lower=[-5.0, -5.0], upper=[5.0, 5.0]),
        ):
            noise = NoiseSettings(range=0.5, bearing=0.1, elevation=0.1)
            sensor = SensorSettings(detection=detection, noise=noise).build('warm_up', dimension)
            ic_phd = FilterSettings(particles=500, birth_particles=50, particles_minimum=50)
            both = (ic_phd, FilterSettings(method='pmb'))
            for settings in [item for item in both if method in (None, item.method)]:
                search = make_filter(settings, bounds, np.random.default_rng(0))
                for step in range(6):
                    position = np.array([3.0 + 0.2 * step, 3.0, 3.0])
                    pose = Pose.from_yaw(position, 0.1)
                    targets = np.array([[5.0, 5.0, 5.0], [2.0, 4.0, 2.0]])[:, :dimension]
                    values = sensor.measurement.measure(targets, pose)
                    if step == 3:
                        values = values[:0]
                    search.step(
                        [AgentMeasurement('warm_up', pose, sensor, values, None, step)], 1, step
                    )
            # Filters of plugins need no more.
            exploration = UnexploredMap(bounds)
            exploration.update(sensor.detection, Pose.from_yaw([3.0, 3.0, 3.0], 0.1))
            exploration.at(np.full((1, 3), 3.0))
        if method in (None, 'pmb'):
            # Kernels of large scans.
            associate(np.ones((1, MANY_PAIRS + 1)), np.ones(MANY_PAIRS + 1))
            position, spread = np.zeros((1, dimension)), np.eye(dimension)[None]
            gaps_of(np.ones((1, 1), np.bool_), position, spread, position, spread)
