"""Conversions between the map and geographic coordinates (WGS 84)."""

import numpy as np
from pydantic import Field

from maasi_filter.arrays import FloatArray
from maasi_filter.settings import Finite, Settings


class OriginSettings(Settings):
    """Geographic position (WGS 84) of x = y = z = 0; x points east, y north, z up."""

    latitude: float = Field(
        ge=-90.0, le=90.0, description='Latitude, positive to the north [degrees]'
    )
    longitude: float = Field(
        ge=-180.0, le=180.0, description='Longitude, positive to the east [degrees]'
    )
    altitude: Finite = Field(0.0, description='Height above the ellipsoid [m]')


def geodetic(positions: FloatArray, origin: OriginSettings) -> FloatArray:
    """Return latitude, longitude [degrees], altitude [m], (n, 3), of positions (n, d) [m, map]."""
    # Deferred: only maps with an origin need it.
    import pymap3d

    east, north, up = np.pad(positions, ((0, 0), (0, 3 - positions.shape[1]))).T
    reference = origin.latitude, origin.longitude, origin.altitude
    return np.stack(pymap3d.enu2geodetic(east, north, up, *reference), axis=1)


def continued(longitudes: FloatArray) -> FloatArray:
    """Return longitudes (n,) [degrees] that continue beyond 180 degrees where they jump.

    By whole turns, as other sums would be rounded, and rings end where they begin.
    """
    turns = np.round(np.diff(longitudes, prepend=longitudes[:1]) / 360.0).cumsum()
    return np.asarray(longitudes - 360.0 * turns)


def to_map(degrees: FloatArray, origin: OriginSettings) -> FloatArray:
    """Return positions (n, 2) [m, map] of longitudes and latitudes (n, 2) [degrees]."""
    import pymap3d

    fixes = degrees[:, 1], degrees[:, 0], np.full(len(degrees), origin.altitude)
    reference = origin.latitude, origin.longitude, origin.altitude
    return np.stack(pymap3d.geodetic2enu(*fixes, *reference)[:2], axis=1)


def on_ground(positions: FloatArray, origin: OriginSettings) -> FloatArray:
    """Return latitude and longitude (n, 2) [degrees] of positions (n, 2) far away on the earth.

    Their height compensates the curvature of the earth.
    """
    up = np.zeros(len(positions))
    for _ in range(60):
        fixes = geodetic(np.column_stack([positions, up]), origin)
        up -= 0.5 * (fixes[:, 2] - origin.altitude)
    return fixes[:, :2]
