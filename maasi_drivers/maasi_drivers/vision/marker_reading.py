"""From an image to the detections that a robot reports."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.sensor_reading import SensorReading
from maasi_drivers.vision.blobs import Blobs
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.label import Label
from maasi_filter.models.sensor import Sensor


def read_markers(
    picture: NDArray[np.uint8] | Blobs, pose: StampedPose, detector: MarkerDetector, sensor: Sensor
) -> SensorReading:
    """Return the markers in a decoded image: segmentation, projection, field of view.

    Driver and in-process search call this same function.

    Parameters
    ----------
    picture : ndarray, shape (h, w, 3), uint8, or Blobs
        R, G, B; or what was segmented on board.
    pose : StampedPose
        Of the robot when the image was taken; an all-zero covariance is unknown.
    detector : MarkerDetector
        Camera and segmentation.
    sensor : Sensor
        Field of view and maximum range.

    Raises
    ------
    ValueError
        If the image has another size than the calibrated one.
    """
    if not isinstance(picture, Blobs):
        picture = detector.segment(picture)
    covariance = pose.covariance if pose.covariance.any() else None
    markers = detector.locate(picture, pose.pose, covariance)
    # On the floor, z = 0.
    positions = np.pad(markers.positions, ((0, 0), (0, sensor.dimension - 2)))
    labels = tuple(Label(identity=name) for name in markers.blobs.identities)
    reading = SensorReading(markers.values, markers.covariances, positions, markers.dropped, labels)
    return reading.in_field_of_view(sensor, pose.pose)
