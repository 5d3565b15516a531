"""The area of a search: where targets may be, how likely they are, and where robots may go."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from numba import njit
from numpy.typing import ArrayLike
from shapely.geometry import box
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.geometry.environment import EnvironmentSettings, Zone
from maasi_filter.geometry.geodesy import on_ground, to_map
from maasi_filter.geometry.raster import read_raster, scaled

_ROUNDING = 1e-6  # of coordinates, also of those that are large [m]
# Cells of the density along the longer side, and every how many are looked at to check it.
_CELLS, _CHECKED = 512, 16
# Ground narrower than this is rounding, not area; twice as far as shapes are rounded [m].
_NARROWEST = 2e-4


@njit(cache=True, error_model='numpy')
def density_at(cells, low, high, x, y):  # type: ignore[no-untyped-def]
    """Return the value of cells (nx, ny) between corners at a position, moved between them."""
    columns, rows = cells.shape
    i = math.floor((x - low[0]) / (high[0] - low[0]) * columns)
    j = math.floor((y - low[1]) / (high[1] - low[1]) * rows)
    return cells[min(max(i, 0), columns - 1), min(max(j, 0), rows - 1)]


@njit(cache=True, error_model='numpy')
def _densities(cells, low, high, points):  # type: ignore[no-untyped-def]
    out = np.empty(len(points))
    for i in range(len(points)):
        out[i] = density_at(cells, low, high, points[i, 0], points[i, 1])
    return out


class Density(NamedTuple):
    """Where targets are expected, in cells.

    values (nx, ny): relative to evenly over the region; share: of the bounds that is inside; even:
    whether the prior promises nothing inside, so that targets are expected evenly.
    """

    values: FloatArray
    share: float
    even: bool


class Area:
    """Where targets may be and robots may go, and how likely targets are, from settings.

    Parameters
    ----------
    environment : EnvironmentSettings or (d, 2) array
        Settings; or the bounds of a box [m], with nothing in it.

    Attributes
    ----------
    bounds : (d, 2) array
        Around the area, metres.
    region : shapely geometry or None
        Level shape of what may hold targets: the area without keep-outs; None: all of `bounds`.
    circles : (n, 5) array
        Of all round zones: x, y, z, radius [m, map], 1 for a sphere, 0 for a cylinder.
    doubts : list of str
        What is valid but has no effect, as a keep-out far away: `key: text`.

    Raises
    ------
    ValueError
        If bounds are not usable, a prior cannot be read, or nothing of the area is left.
    """

    def __init__(self, environment: EnvironmentSettings | ArrayLike) -> None:
        if not isinstance(environment, EnvironmentSettings):
            environment = EnvironmentSettings(bounds=np.asarray(environment, dtype=float).tolist())
        self.settings = environment
        self.bounds = environment.array()
        self.dimension = len(self.bounds)
        self.expected_targets = environment.expected_targets
        self.circles = _circles([*environment.obstacles, *environment.keep_outs])
        #: (n, 5): The same of solid ones.
        self.solid = _circles(environment.obstacles)
        self._solid_polygons = [item.polygon for item in environment.obstacles if item.polygon]
        #: Level shape in which robots stay: the area, or its bounds.
        self.border: BaseGeometry = environment.area or box(*self.bounds[:2].T.ravel())
        closed = list(map(level_shape, environment.keep_outs))
        #: Of what is shown: level shapes by what they are, but for round obstacles.
        self.shapes = {'area': [environment.area] if environment.area else [], 'keep_out': closed}
        self.shapes['obstacle'] = self._solid_polygons
        self.region: BaseGeometry | None = None
        if environment.area is not None or closed:
            self.region = self.border.difference(shapely.union_all(closed))
            if _is_nothing(self.region):
                raise ValueError('environment.keep_outs: leave nothing of the area')
            shapely.prepare(self.region)
        prior = environment.prior
        self._raster = read_raster(environment) if prior.raster else None
        #: Whether targets are equally likely in all of the bounds.
        self.uniform = self.region is None and not prior.polygons and self._raster is None
        self.doubts = self._zones_outside()
        if not self.uniform:
            self.doubts += self._prior_doubts()

    @classmethod
    def of(cls, area: Area | EnvironmentSettings | ArrayLike) -> Area:
        """Return an area as it is, or of settings or bounds."""
        return area if isinstance(area, Area) else cls(area)

    @cached_property
    def volume(self) -> float:
        """Of the region, m^d."""
        whole = float(np.prod(self.bounds[:, 1] - self.bounds[:, 0]))
        return whole if self.uniform else whole * self._rasterised.share

    def inside(self, points: ArrayLike, bounded: bool = True) -> BoolArray:
        """Return which points (n, d or more) are finite and in the area, up to rounding.

        Not `bounded`: in the region only, or anywhere if there is none.
        """
        array = np.asarray(points, dtype=float)
        within = np.isfinite(array).all(axis=1)
        if bounded:
            places = array[:, : self.dimension]
            within &= (places >= self.bounds[:, 0] - _ROUNDING).all(axis=1)
            within &= (places <= self.bounds[:, 1] + _ROUNDING).all(axis=1)
        if self.region is not None and within.any():
            near = shapely.points(array[within, :2])
            within[within] = shapely.dwithin(self.region, near, _ROUNDING)
        return np.asarray(within)

    def outside_by(self, position: ArrayLike) -> float:
        """Return how far a position (3,) is outside of the border [m]; 0: inside."""
        return float(self.border.distance(shapely.Point(np.asarray(position)[:2])))

    def density(self, points: FloatArray) -> FloatArray:
        """Return how likely targets are at points (n, d or more), (n,): prior times inside.

        Relative to evenly over the region: its mean there is 1.
        """
        low, high = self.bounds[:2].T.copy()
        return _densities(self.cells, low, high, np.ascontiguousarray(points[:, :2], dtype=float))

    @cached_property
    def cells(self) -> FloatArray:
        """Density in cells (nx, ny) that fill the bounds, for `density_at`; one if uniform."""
        return np.ones((1, 1)) if self.uniform else self._rasterised.values

    def draw(
        self,
        generator: np.random.Generator,
        low: FloatArray,
        high: FloatArray,
        by_prior: bool = False,
    ) -> FloatArray | None:
        """Return a random place (d,) between corners if it is in the area, else None.

        It is drawn evenly or, `by_prior`, as likely as targets are.
        """
        place = generator.uniform(low, high)
        if self.uniform:
            return np.asarray(place)
        density = float(self.density(place[None, :])[0])
        if by_prior and generator.uniform(0.0, float(self._rasterised.values.max())) > density:
            return None
        return np.asarray(place) if density > 0.0 and self.inside(place[None, :])[0] else None

    def distances(self, position: ArrayLike) -> FloatArray:
        """Return the distances of a position (3,) from solid things, negative inside round ones."""
        offset = np.asarray(position, dtype=float)[None, :] - self.solid[:, :3]
        offset[:, 2] *= self.solid[:, 4]
        gaps = np.sqrt((offset * offset).sum(axis=1)) - self.solid[:, 3]
        if not self._solid_polygons:
            return np.asarray(gaps)
        point = shapely.Point(np.asarray(position)[:2])
        return np.append(gaps, shapely.distance(self._solid_polygons, point))

    def solid_edges(self) -> FloatArray:
        """Return the edges of solid polygons, (n, 4): x, y, and from there to the other end [m]."""
        return edges_of(self._solid_polygons)

    def room(self, reach: float, closed: bool = True) -> BaseGeometry | None:
        """Return where robots that keep `reach` metres from its border may be; None: in a box.

        Round zones are not in it, and the sides of bounds need no distance. closed: whether
        keep-outs count.
        """
        polygons = self._zone_polygons[closed]
        whole = self.settings.area
        if whole is None and polygons.is_empty and not len(self.circles):
            return None
        if whole is None:
            whole = self.border.buffer(reach, join_style='mitre')
        return whole.difference(polygons)

    @cached_property
    def _zone_polygons(self) -> dict[bool, BaseGeometry]:
        """Polygons of obstacles in one shape, and (True) with those of keep-outs."""
        closed = [item.polygon for item in self.settings.keep_outs if item.polygon]
        whole = shapely.union_all([*self._solid_polygons, *closed])
        return {False: shapely.union_all(self._solid_polygons), True: whole}

    @cached_property
    def _rasterised(self) -> Density:
        """Where targets are expected; evenly where the prior promises nothing inside."""
        likely, inside = self._cells()
        share = float(inside.mean())
        if not inside.any():
            low, size = self.bounds[:2, 0], self.bounds[:2, 1] - self.bounds[:2, 0]
            inside = self.outline(low, size / inside.shape, inside.shape)
            share = self.region.area / float(np.prod(size)) if self.region else 1.0
        likely = scaled(likely * inside)
        promised = float(likely.sum() / inside.sum())
        if not promised > 0.0:
            return Density(inside, share, True)
        floor = self.settings.prior.floor
        return Density((floor + (1.0 - floor) * likely / promised) * inside, share, False)

    def outline(self, low: FloatArray, cell: FloatArray, shape: tuple[int, int]) -> FloatArray:
        """Return 1 for the cells of a level grid that the border of the region passes, (nx, ny).

        For grids that are too coarse for it: low, cell (2,): the grid's corner, and its cells [m].
        """
        region = self.border if self.region is None else self.region
        border = shapely.segmentize(region.boundary, 0.5 * float(cell.min()))
        number = np.floor((shapely.get_coordinates(border) - low) / cell).astype(int)
        x, y = np.clip(number, 0, np.array(shape) - 1).T
        marked = np.zeros(shape)
        marked[x, y] = 1.0
        return marked

    def _prior_doubts(self) -> list[str]:
        """Return in words whether the prior promises nothing, or the same everywhere."""
        likely, inside = self._cells(_CHECKED)
        given = bool(self.settings.prior.polygons) or self._raster is not None
        # All cells, which take long and not all users need, only where a few say so.
        if not (likely * inside).any() and self._rasterised.even:
            return [
                'environment.prior: promises nothing inside what is left of the area: targets are '
                'expected evenly over it'
            ]
        if given and inside.any() and np.ptp(likely[inside > 0.0]) == 0.0:
            likely, inside = self._cells()
            if np.ptp(likely[inside > 0.0]) == 0.0:
                return [
                    'environment.prior: is the same everywhere in the area: targets are expected '
                    'evenly over it'
                ]
        return []

    def _zones_outside(self) -> list[str]:
        """Return in words which zones and polygons of the prior touch nothing of the area."""
        given = self.settings
        zones = {
            f'{key}[{index}]': level_shape(zone)
            for key in ('keep_outs', 'obstacles')
            for index, zone in enumerate(getattr(given, key))
        }
        for index, part in enumerate(given.prior.polygons):
            zones[f'prior.polygons[{index}]'] = part.polygon
        if given.prior.raster and given.prior.extent:
            (west, east), (south, north) = given.prior.extent
            zones['prior.extent'] = box(west, south, east, north)
        if self._raster is not None and self._raster.corners is not None:
            zones['prior.raster'] = shapely.Polygon(self._raster.corners)
        doubts = []
        for key, zone in zones.items():
            parts = shapely.get_parts(zone)
            gaps = shapely.distance(self.border, parts)
            away = np.count_nonzero(gaps > 0.0)
            # Maps of Nav2 may well be larger than an area, but what is drawn is drawn for it.
            if not away or (away < len(parts) and key.startswith('obstacles')):
                continue
            place = shapely.get_coordinates(parts[gaps.argmax()].centroid)[0]
            hint = self.exchanged(place, gaps.max())
            lies, where = f'lies {how_far(gaps.min())}', 'where it has no effect'
            if away < len(parts):
                lies = f'{away} of its {len(parts)} polygons lie up to {how_far(gaps.max())}'
                where = 'where they have no effect'
            doubts.append(f'environment.{key}: {lies} outside of the area, {where}{hint}')
        return doubts

    def exchanged(self, position: ArrayLike, gap: float) -> str:
        """Return in words whether a position would lie at the area with latitude for longitude."""
        origin = self.settings.origin
        if origin is None or gap < self.border.length:
            return ''
        degrees = on_ground(np.asarray(position, dtype=float)[None, :2], origin)
        if abs(degrees[0, 1]) > 90.0:
            return ''
        place = shapely.Point(to_map(degrees, origin)[0])
        near = self.border.distance(place) < min(
            max(1e-3 * gap, 2.0 * self.border.length), 0.1 * gap
        )
        return ': with latitude and longitude exchanged it would lie there' if near else ''

    def _cells(self, every: int = 1) -> tuple[FloatArray, FloatArray]:
        """Return prior, and 1 for inside, at the middle of every n-th cell, (nx, ny)."""
        prior = self.settings.prior
        low, high = self.bounds[:2].T
        size = high - low
        number = np.maximum(np.ceil(_CELLS * size / size.max()), 8).astype(int)
        axes = [a + (np.arange(0, n, every) + 0.5) * s / n for a, n, s in zip(low, number, size)]
        x, y = np.meshgrid(*axes, indexing='ij')
        inside, likely = np.ones(x.shape), np.ones(x.shape)
        if self.region is not None:
            inside = shapely.contains_xy(self.region, x, y).astype(float)
        for part in prior.polygons:
            shapely.prepare(part.polygon)
            likely[shapely.contains_xy(part.polygon, x, y)] = part.weight
        if self._raster is not None:
            likely = scaled(likely) * self._raster.at(x, y)
        return likely, inside


def how_far(gap: float) -> str:
    """Return a distance in words."""
    if gap > 1e4:
        return f'{gap / 1e3:,.0f} km'
    return f'{gap:.0f} m' if gap > 100.0 else f'{gap:.3g} m'


def _is_nothing(region: BaseGeometry) -> bool:
    """Return whether a region is empty but for what rounding leaves."""
    narrow = region.area <= _NARROWEST * region.length
    return bool(narrow and region.buffer(-0.5 * _NARROWEST).is_empty)


def level_shape(zone: Zone) -> BaseGeometry:
    """Return the polygon of a zone; a round one as one of 128 corners."""
    if zone.centre is not None:
        return shapely.Point(zone.centre).buffer(zone.radius or 0.0, quad_segs=32)
    assert zone.polygon is not None
    return zone.polygon


def edges_of(polygons: Iterable[BaseGeometry]) -> FloatArray:
    """Return the edges of polygons, (n, 4): x, y, and from there to the other end [m]."""
    rows = [np.zeros((0, 4))]
    for ring in shapely.get_rings(shapely.get_parts(list(polygons))):
        corners = shapely.get_coordinates(ring)
        rows.append(np.hstack([corners[:-1], np.diff(corners, axis=0)]))
    edges = np.concatenate(rows)
    return np.asarray(edges[(edges[:, 2:] != 0.0).any(axis=1)])


def _circles(zones: Iterable[Zone]) -> FloatArray:
    rows = [
        [*[*zone.centre, 0.0][:3], zone.radius, float(len(zone.centre) == 3)]
        for zone in zones
        if zone.centre is not None
    ]
    return np.array(rows, dtype=float).reshape(-1, 5)
