"""Boxes in images, as detectors of other packages publish them, to points on the floor."""

from typing import Any

import numpy as np

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.detector import Blobs
from maasi_filter.arrays import FloatArray
from maasi_filter.records import UNLABELLED, Label
from maasi_filter.ros.conversions import label_problem


def boxes_to_blobs(message: Any, camera: CameraSettings) -> tuple[Blobs, list[str]]:
    """Return the boxes of a `vision_msgs/Detection2DArray` that are used, and errors of others.

    A box is labelled by its hypothesis with the largest score. The id of a tracker is no identity:
    it is another one when a target is seen again.
    """
    settings, size = camera.detections, np.array([camera.width, camera.height], dtype=float)
    assert settings is not None
    corners, labels, problems = [], [], []
    for item in message.detections:
        hypotheses = [result.hypothesis for result in item.results] or [UNLABELLED]
        best = max(hypotheses, key=lambda hypothesis: float(hypothesis.score))
        try:
            label = Label(best.class_id, best.score)
            if (problem := label_problem(label)) is not None:
                raise ValueError(problem)
            if not settings.classes or label.class_id in settings.classes:
                corners.append(_corners(item.bbox, size))
                labels.append(label)
        except ValueError as error:
            problems.append(str(error))
    low, high = np.reshape(np.array(corners, dtype=float), (-1, 2, 2)).transpose(1, 0, 2)
    points, extents = 0.5 * (low + high), high - low
    if settings.point == 'foot':
        points[:, 1] = high[:, 1]
    # Of a cut box the point may be outside of the image.
    cut = ((low < 1.0) | (high > size - 1.0)).any(axis=1)
    deviations = np.where(cut, 0.5, settings.error)[:, None] * extents
    blobs = Blobs(
        # A box that is 1 px wide reaches from 0 to 1, while pixel centres are at whole numbers.
        points - 0.5,
        extents.prod(axis=1),
        extents,
        cut,
        deviations[:, :, None] ** 2 * np.eye(2),
        tuple(labels),
        message.header.frame_id.strip('/'),
    )
    return blobs, problems


def _corners(box: Any, size: FloatArray) -> FloatArray:
    """Return the least and largest x and y of a box, which may be turned, in the image (2, 2)."""
    place, turn = box.center.position, box.center.theta
    numbers = np.array([place.x, place.y, box.size_x, box.size_y, turn])
    centre, extent = numbers[:2], numbers[2:4]
    inside = (centre >= 0.0).all() and (centre <= size).all()
    if not (inside and np.isfinite(numbers).all() and (extent > 0.0).all()):
        raise ValueError(
            f'bbox: read centre, size and theta {numbers.tolist()}, allowed are a centre inside '
            f'{size[0]:g} x {size[1]:g} px, sizes above 0 and a finite theta'
        )
    cosine, sine = abs(np.cos(turn)), abs(np.sin(turn))
    half = 0.5 * np.array([[cosine, sine], [sine, cosine]]) @ extent
    return np.clip([centre - half, centre + half], 0.0, size)
