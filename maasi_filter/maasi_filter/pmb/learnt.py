"""What the scans of each robot have told of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.pmb.clutter import ClutterEstimate
from maasi_filter.pmb.component import Component
from maasi_filter.pmb.consistency import Consistency
from maasi_filter.pmb.noise_scale import NoiseScale, innovations
from maasi_filter.pmb.position_error import PositionErrors


@dataclass
class Learnt:
    """Clutter, noise and errors of the robots, and whether they fit."""

    clutter: ClutterEstimate = field(default_factory=ClutterEstimate)
    noise: NoiseScale = field(default_factory=NoiseScale)
    errors: PositionErrors = field(default_factory=PositionErrors)
    consistency: Consistency = field(default_factory=Consistency)

    def count_found(
        self,
        member: CheckedMeasurement,
        components: Sequence[Component],
        caused: FloatArray,
        blurred: bool,
    ) -> None:
        """Count the innovations of the detections that found targets caused.

        Parameters
        ----------
        member : CheckedMeasurement
            As it is believed.
        caused : (n, m) array
            Probability that component i caused detection j.
        blurred : bool
            Whether an error of the position explains the scan: it does not tell the noise then.
        """
        own = [i for i, item in enumerate(components) if item.target and not item.foreign]
        rows = [i for i in own if caused[i].max(initial=0.0) > 0.5]
        if not rows:
            return
        d = member.values.shape[1]
        densities = [components[i].density for i in rows]
        means = np.array([density.mean for density in densities])
        covariances = np.array([density.covariance for density in densities])
        squares = innovations(member, means, covariances).squares
        for row, j in np.argwhere(caused[rows] > 0.5).tolist():
            square = float(squares[row, j])
            self.consistency.count(member.robot, square, d)
            if not blurred:
                self.noise.count(member.robot, float(caused[rows[row], j]), square / d)
