"""The filter that the settings name: new, from a file, or resumed; its kernels compiled."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.ic_phd.filter import IcPhdFilter
from maasi_filter.models.detection import PARAMETERS, detection_probability
from maasi_filter.models.pose import Pose
from maasi_filter.pmb.filter import PmbFilter
from maasi_filter.records import AgentMeasurement
from maasi_filter.search_filter import SearchFilter
from maasi_filter.settings import (
    DetectionSettings,
    FilterSettings,
    NoiseSettings,
    SensorSettings,
)
from maasi_filter.state_file import SavedState, write_state


def make_filter(
    settings: FilterSettings, bounds: ArrayLike, generator: np.random.Generator
) -> SearchFilter:
    """Return a new filter of the method that the settings name.

    Parameters
    ----------
    bounds : (d, 2) array
        Of the environment, metres; d = 2 or 3.
    generator : numpy.random.Generator
        Every random draw comes from it.

    Raises
    ------
    ValueError
        If the bounds or the spacing of the exploration grid are not usable.
    """
    if settings.method == 'pmb':
        return PmbFilter(settings, bounds, generator)
    return IcPhdFilter(settings, bounds, generator)


def load_filter(path: str | os.PathLike[str]) -> SearchFilter:
    """Return the saved filter; it continues bit for bit as the saved one would have.

    Raises
    ------
    StateFileError
        If the file is missing, of another format or version, or damaged; it says which.
    """
    return filter_of(SavedState(path))


def filter_of(saved: SavedState) -> SearchFilter:
    """Return the filter of a file.

    Raises
    ------
    StateFileError
        If something is missing, or has a wrong type, shape or number.
    """
    return PmbFilter.of(saved) if PmbFilter.method in saved else IcPhdFilter.of(saved)


def warm_up() -> None:
    """Compile, or load from the cache, every kernel that a step uses.

    A node calls this before it reports ready, so that no step waits for a compiler.
    """
    for dimension in (2, 3):
        bounds = np.array([[0.0, 10.0]] * dimension)
        for detection in (
            DetectionSettings(kind='exponential', size=[5.0] * dimension),
            DetectionSettings(kind='box', lower=[-5.0, -5.0], upper=[5.0, 5.0]),
        ):
            noise = NoiseSettings(range=0.5, bearing=0.1, elevation=0.1)
            sensor = SensorSettings(detection=detection, noise=noise).build('warm_up', dimension)
            ic_phd = FilterSettings(particles=500, birth_particles=50, particles_minimum=50)
            for settings in (ic_phd, FilterSettings(method='pmb')):
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
                search.exploration.at(np.full((1, 3), 3.0))
    origin = np.zeros(3)
    detection_probability(0, np.zeros(PARAMETERS), origin, origin, 0.0)


@dataclass
class Progress:
    """Progress of a run after a batch."""

    batch: int  # Id of the last batch
    stamp: int  # Of the last batch [ns]
    step: int  # Of the last batch
    #: Id of the batch that completed each found target, by the id of the target.
    settled_by: dict[int, int] = field(default_factory=dict)
    #: Batch, measurement and stamp [ns] of the last detections, by robot.
    heard: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    #: The last update, as published and serialised; it may not have been sent yet.
    update: bytes = b''


class FilterMemory:
    """Keeps a filter with its progress in a file, replaced atomically after each batch.

    The file survives the death of the process, not a power failure: it is not forced to the disk.
    """

    def __init__(self, path: str) -> None:
        self.path = Path(path)

    def save(self, search: SearchFilter, progress: Progress) -> None:
        """Save both; OSError if the file cannot be written: the old one is kept."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_state(self.path, {**search.state(), 'progress': progress}, durable=False)

    def load(self) -> tuple[SearchFilter, Progress] | None:
        """Return the saved filter and progress, or None without a file."""
        if not self.path.exists():
            return None
        saved = SavedState(self.path)
        return filter_of(saved), saved.read('progress', Progress)

    def set_aside(self) -> Path:
        """Rename a file that cannot be used, to keep it for inspection; return its new name."""
        aside = self.path.with_name(f'{self.path.name}.refused')
        self.path.replace(aside)
        return aside

    def forget(self) -> None:
        """Remove the file of a search that has ended."""
        self.path.unlink(missing_ok=True)
