"""Where the map lies on the earth (WGS 84)."""

import numpy as np
from pydantic import Field

from maasi_filter.arrays import FloatArray
from maasi_filter.settings import Finite, Settings


class OriginSettings(Settings):
    """Where x = y = z = 0 of the map lies, on WGS 84; x points east, y north, z up."""

    latitude: float = Field(
        ge=-90.0, le=90.0, description='Latitude, positive to the north [degrees]'
    )
    longitude: float = Field(
        ge=-180.0, le=180.0, description='Longitude, positive to the east [degrees]'
    )
    altitude: Finite = Field(0.0, description='Height above the ellipsoid [m]')


def geodetic(positions: FloatArray, origin: OriginSettings) -> FloatArray:
    """Return latitude, longitude [degrees] and altitude [m] of places (n, d) [m, map], (n, 3)."""
    # Deferred: only maps with an origin need it.
    import pymap3d

    east, north, up = np.pad(positions, ((0, 0), (0, 3 - positions.shape[1]))).T
    reference = origin.latitude, origin.longitude, origin.altitude
    return np.stack(pymap3d.enu2geodetic(east, north, up, *reference), axis=1)


def to_map(degrees: FloatArray, origin: OriginSettings) -> FloatArray:
    """Return places on the map (n, 2) [m] of longitudes and latitudes (n, 2) [degrees]."""
    import pymap3d

    places = degrees[:, 1], degrees[:, 0], np.full(len(degrees), origin.altitude)
    reference = origin.latitude, origin.longitude, origin.altitude
    return np.stack(pymap3d.geodetic2enu(*places, *reference)[:2], axis=1)


def on_ground(positions: FloatArray, origin: OriginSettings) -> FloatArray:
    """Return latitude and longitude (n, 2) [degrees] of places (n, 2) that lie far away on earth.

    Up is what brings them to the origin's altitude, as the earth curves away below the map.
    """
    up = np.zeros(len(positions))
    for _ in range(60):
        places = geodetic(np.column_stack([positions, up]), origin)
        up -= 0.5 * (places[:, 2] - origin.altitude)
    return places[:, :2]
