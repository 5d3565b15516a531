"""The search area: its shape, the density of targets, and where robots may go."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
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
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.geometry.terrain_file import read_terrain

_ROUNDING = 1e-6  # of coordinates [m]
# Cells of the density along the longer side, and the stride of a first check.
_CELLS, _CHECKED = 512, 16
# Ground narrower than this is rounding: twice the rounding of shapes [m].
_NARROWEST = 2e-4


@njit(cache=True, error_model='numpy')
def density_at(cells, low, high, x, y):  # type: ignore[no-untyped-def]
    """Return the value of cells (nx, ny) between two corners at a position, clamped to them."""
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
    """Density of targets in cells.

    values (nx, ny) are relative to a uniform density over the region; share is the part of the
    bounds that is inside; even is whether the prior is 0 everywhere inside, and a uniform one is
    used.
    """

    values: FloatArray
    share: float
    even: bool


class Sighting(NamedTuple):
    """Targets that a person expects: a normal density around a position, cut at the area."""

    x: float  # [m, map]
    y: float
    radius: float  # two standard deviations [m]
    weight: float  # expected number of targets


class Area:
    """Where targets are expected and robots may go.

    Parameters
    ----------
    environment : EnvironmentSettings or (d, 2) array
        Settings, or the bounds of an empty box [m].

    Attributes
    ----------
    bounds : (d, 2) array
        Bounding box, metres.
    region : shapely geometry or None
        Horizontal outline of the area without keep-outs; None: all of `bounds`.
    circles : (n, 5) array
        Round zones: x, y, z, radius [m, map], and 1 for a sphere or 0 for a cylinder.
    terrain : Terrain or None
        Ground on which targets stand; None: the plane z = 0.
    warnings : list of str
        Warnings about valid input without effect, such as a keep-out far away: `key: text`.

    Raises
    ------
    ValueError
        If bounds are invalid, a prior or terrain cannot be read, or keep-outs cover the whole area.
    """

    def __init__(self, environment: EnvironmentSettings | ArrayLike) -> None:
        if not isinstance(environment, EnvironmentSettings):
            environment = EnvironmentSettings(bounds=np.asarray(environment, dtype=float).tolist())
        self.settings = environment
        self.bounds = environment.array()
        self.dimension = len(self.bounds)
        self.expected_targets = environment.expected_targets
        #: Sightings during the search, which the prior and `expected_targets` include.
        self.sightings: tuple[Sighting, ...] = ()
        self.circles = _circles([*environment.obstacles, *environment.keep_outs])
        #: `circles` of solid obstacles only, (n, 5).
        self.solid = _circles(environment.obstacles)
        self._solid_polygons = [item.polygon for item in environment.obstacles if item.polygon]
        #: Horizontal outline in which robots stay: the area, or its bounds.
        self.border: BaseGeometry = environment.area or box(*self.bounds[:2].T.ravel())
        closed = list(map(level_shape, environment.keep_outs))
        #: Horizontal outlines for display by kind, without round obstacles.
        self.shapes = {'area': [environment.area] if environment.area else [], 'keep_out': closed}
        self.shapes['obstacle'] = self._solid_polygons
        self.region: BaseGeometry | None = None
        if environment.area is not None or closed:
            self.region = self.border.difference(shapely.union_all(closed))
            if _is_nothing(self.region):
                raise ValueError('environment.keep_outs: cover the whole area')
            shapely.prepare(self.region)
        prior = environment.prior
        self._raster = read_raster(environment) if prior.raster else None
        #: Whether targets are equally likely in all of the bounds.
        self.uniform = self.region is None and not prior.polygons and self._raster is None
        self.warnings = self._zones_outside()
        self.terrain: Terrain | None = None
        if environment.terrain.file is not None:
            self.terrain, assumed = read_terrain(environment)
            self.warnings += assumed
        if not self.uniform:
            self.warnings += self._prior_warnings()

    @classmethod
    def of(cls, area: Area | EnvironmentSettings | ArrayLike) -> Area:
        """Return an area as it is, or the area of settings or bounds."""
        return area if isinstance(area, Area) else cls(area)

    def with_sightings(self, sightings: Sequence[Sighting]) -> Area:
        """Return the same area with other sightings."""
        other = copy.copy(self)
        for name in ('volume', 'cells', '_rasterised'):
            other.__dict__.pop(name, None)
        other.sightings = tuple(sightings)
        alike = self.region is None and not self.settings.prior.polygons and self._raster is None
        other.uniform = alike and not sightings
        added = math.fsum(item.weight for item in sightings)
        other.expected_targets = self.settings.expected_targets + added
        return other

    @cached_property
    def volume(self) -> float:
        """Volume of the region, m^d."""
        whole = float(np.prod(self.bounds[:, 1] - self.bounds[:, 0]))
        return whole if self.uniform else whole * self._rasterised.share

    def inside(self, points: ArrayLike, bounded: bool = True) -> BoolArray:
        """Return which points (n, d or more) [m] are finite and in the area, up to rounding.

        Unless `bounded`, the bounds do not count.
        """
        array = np.asarray(points, dtype=float)
        within = np.isfinite(array).all(axis=1)
        if bounded:
            coordinates = array[:, : self.dimension]
            within &= (coordinates >= self.bounds[:, 0] - _ROUNDING).all(axis=1)
            within &= (coordinates <= self.bounds[:, 1] + _ROUNDING).all(axis=1)
        if self.region is not None and within.any():
            near = shapely.points(array[within, :2])
            within[within] = shapely.dwithin(self.region, near, _ROUNDING)
        return np.asarray(within)

    def outside_by(self, position: ArrayLike) -> float:
        """Return the distance of a position (3,) from the border [m]; 0 inside."""
        return float(self.border.distance(shapely.Point(np.asarray(position)[:2])))

    def above_ground(self, position: ArrayLike) -> FloatArray:
        """Return a position (3,) whose z is above ground in the map [m]."""
        found = np.array(position, dtype=float)
        if self.terrain is not None:
            found[2] += self.terrain.height(found)
        return found

    def density(self, points: FloatArray) -> FloatArray:
        """Return the density of targets (n,) at points (n, d or more) [m]; its mean is 1."""
        low, high = self.bounds[:2].T.copy()
        return _densities(self.cells, low, high, np.ascontiguousarray(points[:, :2], dtype=float))

    @cached_property
    def cells(self) -> FloatArray:
        """Density in cells (nx, ny) that fill the bounds, for `density_at`."""
        return np.ones((1, 1)) if self.uniform else self._rasterised.values

    def draw(
        self,
        generator: np.random.Generator,
        low: FloatArray,
        high: FloatArray,
        by_prior: bool = False,
    ) -> FloatArray | None:
        """Return a random position (d,) between corners if it is in the area, else None.

        It is drawn uniformly or, `by_prior`, from the density of targets.
        """
        position = generator.uniform(low, high)
        if self.uniform:
            return np.asarray(position)
        density = float(self.density(position[None, :])[0])
        if by_prior and generator.uniform(0.0, float(self._rasterised.values.max())) > density:
            return None
        return np.asarray(position) if density > 0.0 and self.inside(position[None, :])[0] else None

    def distances(self, position: ArrayLike) -> FloatArray:
        """Return the distances of a position (3,) from obstacles [m]; negative in round ones."""
        offset = np.asarray(position, dtype=float)[None, :] - self.solid[:, :3]
        offset[:, 2] *= self.solid[:, 4]
        gaps = np.sqrt((offset * offset).sum(axis=1)) - self.solid[:, 3]
        if not self._solid_polygons:
            return np.asarray(gaps)
        point = shapely.Point(np.asarray(position)[:2])
        return np.append(gaps, shapely.distance(self._solid_polygons, point))

    def solid_edges(self) -> FloatArray:
        """Return the edges of solid polygons, (n, 4): x, y, and the vector to the other end [m]."""
        return edges_of(self._solid_polygons)

    def free_space(self, reach: float, closed: bool = True) -> BaseGeometry | None:
        """Return where robots that keep `reach` metres from the border may be; None: in a box.

        Round zones and the sides of bounds do not count; keep-outs count if `closed`.
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
        """Polygons of obstacles, and (True) of obstacles and keep-outs, each as one shape."""
        closed = [item.polygon for item in self.settings.keep_outs if item.polygon]
        whole = shapely.union_all([*self._solid_polygons, *closed])
        return {False: shapely.union_all(self._solid_polygons), True: whole}

    @cached_property
    def _rasterised(self) -> Density:
        """Density of targets; uniform if the prior is 0 everywhere inside."""
        likely, inside = self._cells()
        share = float(inside.mean())
        if not inside.any():
            low, size = self.bounds[:2, 0], self.bounds[:2, 1] - self.bounds[:2, 0]
            inside = self.outline(low, size / inside.shape, inside.shape)
            share = self.region.area / float(np.prod(size)) if self.region else 1.0
        likely = scaled(likely * inside)
        promised = float(likely.sum() / inside.sum())
        if not promised > 0.0:
            return Density(self._with_seen(inside, inside), share, True)
        floor = self.settings.prior.floor
        values = (floor + (1.0 - floor) * likely / promised) * inside
        return Density(self._with_seen(values, inside), share, False)

    def _with_seen(self, values: FloatArray, inside: FloatArray) -> FloatArray:
        """Return the density with the sightings: (N0 f + sum of w_i f_i) / (N0 + sum of w_i)."""
        if not self.sightings:
            return values
        low, high = self.bounds[:2].T
        cell = (high - low) / values.shape
        x, y = (a + (np.arange(n) + 0.5) * s for a, s, n in zip(low, cell, values.shape))
        total = self.settings.expected_targets * values
        for item in self.sightings:
            square = (x - item.x)[:, None] ** 2 + (y - item.y)[None, :] ** 2
            # A normal density that is narrower than a cell is as wide as that.
            deviation = max(0.5 * item.radius, 0.5 * float(cell.max()))
            # Relative to the nearest cell inside, so that no weight is lost.
            square -= square[inside > 0.0].min()
            share = np.exp(-0.5 * np.maximum(square, 0.0) / deviation**2) * inside
            total += item.weight * float(inside.sum()) / float(share.sum()) * share
        return np.asarray(total / self.expected_targets)

    def outline(self, low: FloatArray, cell: FloatArray, shape: tuple[int, int]) -> FloatArray:
        """Return 1 for cells (corner `low`, size `cell`) that the border of the region crosses."""
        region = self.border if self.region is None else self.region
        border = shapely.segmentize(region.boundary, 0.5 * float(cell.min()))
        number = np.floor((shapely.get_coordinates(border) - low) / cell).astype(int)
        x, y = np.clip(number, 0, np.array(shape) - 1).T
        marked = np.zeros(shape)
        marked[x, y] = 1.0
        return marked

    def _prior_warnings(self) -> list[str]:
        likely, inside = self._cells(_CHECKED)
        given = bool(self.settings.prior.polygons) or self._raster is not None
        # All cells are slow: only if a few of them suggest it.
        if not (likely * inside).any() and self._rasterised.even:
            return [
                'environment.prior: is 0 everywhere in the open area: targets are expected evenly '
                'over it'
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
        warnings = []
        for key, zone in zones.items():
            parts = shapely.get_parts(zone)
            gaps = shapely.distance(self.border, parts)
            away = np.count_nonzero(gaps > 0.0)
            # Maps of Nav2 may be larger than the area.
            if not away or (away < len(parts) and key.startswith('obstacles')):
                continue
            centroid = shapely.get_coordinates(parts[gaps.argmax()].centroid)[0]
            hint = self.exchanged(centroid, gaps.max())
            lies, where = f'lies {how_far(gaps.min())}', 'where it has no effect'
            if away < len(parts):
                lies = f'{away} of its {len(parts)} polygons lie up to {how_far(gaps.max())}'
                where = 'where they have no effect'
            warnings.append(f'environment.{key}: {lies} outside of the area, {where}{hint}')
        return warnings

    def exchanged(self, position: ArrayLike, gap: float) -> str:
        """Return a hint if swapping latitude and longitude would move a position into the area."""
        origin = self.settings.origin
        if origin is None or gap < self.border.length:
            return ''
        degrees = on_ground(np.asarray(position, dtype=float)[None, :2], origin)
        if abs(degrees[0, 1]) > 90.0:
            return ''
        swapped = shapely.Point(to_map(degrees, origin)[0])
        near = self.border.distance(swapped) < min(
            max(1e-3 * gap, 2.0 * self.border.length), 0.1 * gap
        )
        return ': with latitude and longitude swapped it would lie inside' if near else ''

    def _cells(self, every: int = 1) -> tuple[FloatArray, FloatArray]:
        """Return the prior, and 1 for inside, at the centre of every n-th cell, (nx, ny)."""
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
    """Return a distance as text."""
    if gap > 1e4:
        return f'{gap / 1e3:,.0f} km'
    return f'{gap:.0f} m' if gap > 100.0 else f'{gap:.3g} m'


def _is_nothing(region: BaseGeometry) -> bool:
    narrow = region.area <= _NARROWEST * region.length
    return bool(narrow and region.buffer(-0.5 * _NARROWEST).is_empty)


def level_shape(zone: Zone) -> BaseGeometry:
    """Return the horizontal outline of a zone; a round zone has 128 corners."""
    if zone.centre is not None:
        return shapely.Point(zone.centre).buffer(zone.radius or 0.0, quad_segs=32)
    assert zone.polygon is not None
    return zone.polygon


def edges_of(polygons: Iterable[BaseGeometry]) -> FloatArray:
    """Return the edges of polygons, (n, 4): x, y, and the vector to the other end [m]."""
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
