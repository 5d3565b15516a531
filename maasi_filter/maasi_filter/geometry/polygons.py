"""Polygons from corners and well-known text; invalid ones are refused."""

import json
import re
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

# Offsets of outlines that are jagged and have more corners take minutes and gigabytes.
MOST_CORNERS, _FINEST, _COARSEST = 10_000, 0.01, 10.0  # and detail that may be removed [m]
_WKT = re.compile(r'\s*(MULTI)?POLYGON\s*(Z|M|ZM)?\s*(\(|EMPTY)', re.IGNORECASE)


class InputWarning(UserWarning):
    """An assumption about an input, or an ignored part of it."""


def warn(text: str) -> None:
    """Issue an InputWarning."""
    warnings.warn(text, InputWarning, stacklevel=3)


def short(value: Any) -> str:
    """Return the beginning of a value as JSON, for messages."""
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= 60 else f'{text[:57]}...'


def sound(found: BaseGeometry, words: str, unit: str = 'm') -> BaseGeometry:
    """Return valid polygons; ValueError with `words`, what was read, for others."""
    if not isinstance(found, (Polygon, MultiPolygon)) or found.is_empty:
        raise ValueError(f'{words}, allowed are polygons')
    if not found.is_valid:
        reason = str(shapely.is_valid_reason(found))
        what, location = re.fullmatch(r'([^\[]*)(?:\[(.*)\])?', reason).groups()  # type: ignore[union-attr]
        where = ''
        if location:
            x, y = (float(number) for number in location.split()[:2])
            named = (f'longitude {x:.6f}, latitude {y:.6f}', f'({x:.2f}, {y:.2f}) m')
            where = f' at {named[unit == "m"]}'
        raise ValueError(f'{words}: {what.lower()}{where}; allowed are polygons that are simple')
    return found


def with_few_corners(shape: BaseGeometry, where: str) -> BaseGeometry:
    """Return polygons [m] without fine detail if they have very many corners; warn about that."""
    corners, detail, found = int(shapely.get_num_coordinates(shape)), 0.5 * _FINEST, shape
    while shapely.get_num_coordinates(found) > MOST_CORNERS and detail < _COARSEST:
        detail = min(2.0 * detail, _COARSEST)
        found = shapely.simplify(shape, detail)
    if found is not shape:
        left = int(shapely.get_num_coordinates(found))
        warn(
            f'{where}: has {corners:,} corners: read as {left:,}, at most {detail:g} m off; draw '
            'fewer ones to choose them'
        )
    return found


def is_wkt(value: Any) -> bool:
    """Return whether a value is well-known text of polygons."""
    return isinstance(value, str) and _WKT.match(value) is not None


def of_text(value: str) -> BaseGeometry:
    """Return the polygons of well-known text."""
    try:
        return sound(shapely.from_wkt(value), f'read {short(value)}')
    except shapely.GEOSException:
        raise ValueError(
            f'read {short(value)}, allowed is text as POLYGON ((0 0, 9 0, 9 9, 0 0))'
        ) from None


def of_rings(value: Sequence[Any]) -> BaseGeometry:
    """Return the polygon of corners, or of rings, of which the first is the outer one [m]."""
    try:
        rings = value if np.ndim(value[0][0]) else [value]
        corners = [np.array([[*row] for row in ring], dtype=float) for ring in rings]
    except (TypeError, ValueError, LookupError):
        raise ValueError(f'read {short(value)}, allowed are corners [[x, y], ...]') from None
    for ring in corners:
        if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 3:
            raise ValueError(
                f'read {short(value)}, allowed are at least 3 corners of two numbers, [[x, y], ...]'
            )
        if not np.isfinite(ring).all():
            raise ValueError(f'read {short(value)}, allowed are finite numbers')
    return sound(Polygon(corners[0], corners[1:]), f'read {short(value)}')
