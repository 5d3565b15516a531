"""A sensor of your own that sees ahead, in a cone: once as a function of NumPy, once compiled."""

import math

import numpy as np
from numba import njit
from pydantic import Field

from maasi_filter.models.own_detection import OwnDetection
from maasi_filter.settings import Settings


class ConeSettings(Settings):
    reach: float = Field(default=1.5, gt=0.0, description='Nothing is seen from farther away [m]')
    half_angle: float = Field(default=0.8, gt=0.0, description='Where pi is 0.6 of ahead [rad]')


class Cone(OwnDetection):
    """By a function of NumPy: short to write; it is called once, and then looked up."""

    Settings = ConeSettings

    def reach(self):
        return self.own.reach

    def evaluate(self, forward, left, up):
        angle = np.arctan2(np.hypot(left, up), forward)
        return np.exp(-0.5 * (angle / self.own.half_angle) ** 2)


@njit(error_model='numpy')
def cone(forward, left, up, values):
    angle = math.atan2(math.hypot(left, up), forward)
    return math.exp(-0.5 * (angle / values[0]) ** 2)


class CompiledCone(Cone):
    """The same, compiled: exact, and called for every place."""

    compiled = cone

    def values(self):
        return [self.own.half_angle]
