"""Clutter rates of the robots' sensors, estimated from detections that no target explains."""

from __future__ import annotations

from dataclasses import dataclass, field

from maasi_filter.clutter import LEAST_PER_SCAN

# Weight of the prior, in scans.
PRIOR_SCANS = 10.0


@dataclass
class ClutterEstimate:
    """Mean number of false detections in a scan, with a gamma prior, for each robot.

    The mean of the prior is the configured rate of the sensor, at least LEAST_PER_SCAN; its weight
    is PRIOR_SCANS scans.

    Attributes
    ----------
    scans, counts : dict
        By robot: scans, and expected number of false detections in them.
    """

    scans: dict[str, int] = field(default_factory=dict)
    counts: dict[str, float] = field(default_factory=dict)

    def per_scan(self, robot: str, told: float) -> float:
        """Return the posterior mean for a robot with a configured rate of `told` per scan."""
        prior = max(told, LEAST_PER_SCAN)
        count = PRIOR_SCANS * prior + self.counts.get(robot, 0.0)
        return count / (PRIOR_SCANS + self.scans.get(robot, 0))

    def count(self, robot: str, false_detections: float) -> None:
        """Add a scan with an expected number of false detections."""
        self.scans[robot] = self.scans.get(robot, 0) + 1
        self.counts[robot] = self.counts.get(robot, 0.0) + false_detections
