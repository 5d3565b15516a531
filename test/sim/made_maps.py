"""Occupancy maps of Nav2 as a mapping run leaves them, made from a seed: a room and a hall."""

from __future__ import annotations

from pathlib import Path

import numpy as np

FREE, UNKNOWN, OCCUPIED = 254, 205, 0


def pillar_room(folder: Path, seed: int) -> Path:
    """Write the map of a hexagonal room with nine pillars, and return its YAML.

    It is 5 m wide around the origin, in cells of 0.05 m; walls are thin and ragged, with nothing
    known behind them, as the pillars are hollow.
    """
    rng, cell, side = np.random.default_rng(seed), 0.05, 384
    x, y = _middles(side, side, cell, (-9.6, -9.6))
    # How far inside a hexagon with a flat top and bottom; its corners lie on x.
    turned = [x * np.cos(a) + y * np.sin(a) for a in np.arange(6) * np.pi / 3.0 + np.pi / 6.0]
    inside = 2.5 - np.max(turned, axis=0)
    grey = np.where(inside > 0.0, FREE, UNKNOWN)
    ragged = 0.25 * cell * rng.standard_normal(x.shape)
    grey[np.abs(inside + ragged) < 0.6 * cell] = OCCUPIED
    for px in (-1.1, 0.0, 1.1):
        for py in (-1.1, 0.0, 1.1):
            away = np.hypot(x - px, y - py)
            grey[away < 0.13] = UNKNOWN
            ring = np.abs(away - 0.15 + 0.5 * ragged) < 0.6 * cell
            grey[ring & (rng.random(x.shape) < 0.9)] = OCCUPIED
    return _write(folder, 'pillar_room', grey, cell, (-9.6, -9.6))


def hall(folder: Path, seed: int, cell: float = 0.03) -> Path:
    """Write the map of a hall of 30 m x 50 m around the origin, and return its YAML.

    Shelves are ragged outlines with nothing known inside, racks are double rows of dots, and
    columns, a pallet and a few specks of a person stand between them.
    """
    rng = np.random.default_rng(seed)
    low, columns, rows = (-15.1, -25.1), round(30.2 / cell), round(50.2 / cell)
    x, y = _middles(rows, columns, cell, low)
    grey = np.full(x.shape, FREE)

    def outlined(west: float, south: float, east: float, north: float, filled: int) -> None:
        inner = np.minimum(
            np.minimum(x - west, east - x), np.minimum(y - south, north - y)
        ) + 0.12 * cell * rng.standard_normal(x.shape)
        grey[inner > 0.0] = filled
        grey[np.abs(inner) < 1.1 * cell] = OCCUPIED

    def rack(west: float, south: float, east: float, north: float) -> None:
        """Draw a low rack: two rows of posts, with gaps that no robot passes."""
        within = (x > west) & (x < east) & (y > south) & (y < north)
        along = y if north - south > east - west else x
        across = x - 0.5 * (west + east) if along is y else y - 0.5 * (south + north)
        rails = np.abs(np.abs(across) - 0.2) < 1.1 * cell
        grey[within & rails & (rng.random(x.shape) < 0.75)] = OCCUPIED
        posts = np.abs(along / 0.25 - np.round(along / 0.25)) * 0.25 < 0.6 * cell
        grey[within & posts & (np.abs(across) < 0.2) & (rng.random(x.shape) < 0.4)] = OCCUPIED

    wall = np.minimum(15.0 - np.abs(x), 25.0 - np.abs(y))
    grey[wall + 0.1 * cell * rng.standard_normal(x.shape) < 0.0] = UNKNOWN
    grey[np.abs(wall + 0.1 * cell * rng.standard_normal(x.shape)) < 1.2 * cell] = OCCUPIED
    for west in (-10.0, -3.0, 5.0):
        outlined(west, -22.0, west + 2.1, -4.0, UNKNOWN)
    outlined(-10.3, 17.0, 7.7, 19.1, UNKNOWN)
    outlined(-5.5, 8.0, 12.5, 10.1, UNKNOWN)
    outlined(-10.7, 4.5, -10.1, 16.6, UNKNOWN)
    outlined(-4.6, 11.7, -3.5, 12.5, UNKNOWN)
    for place in ((-7.3, 21.0), (7.6, 4.5), (-2.0, -2.2), (11.3, -15.0), (11.3, -21.0)):
        rack(place[0], place[1], place[0] + 3.6, place[1] + 0.5)
    for px in (-7.5, 7.5):
        for py in (-14.5, -7.0, 0.5, 6.5, 14.8):
            outlined(px - 0.25, py - 0.25, px + 0.25, py + 0.25, OCCUPIED)
    for px, py in ((-12.5, 14.5), (-13.5, 6.5), (14.2, -5.0), (1.0, -0.8)):
        specks = np.hypot(x - px, y - py) < 0.5
        grey[specks & (rng.random(x.shape) < 0.02)] = OCCUPIED
    return _write(folder, 'hall', grey, cell, low)


def _middles(
    rows: int, columns: int, cell: float, low: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of the middles of all cells, the first row north."""
    x = low[0] + cell * (np.arange(columns) + 0.5)
    y = low[1] + cell * (np.arange(rows)[::-1] + 0.5)
    across, up = np.meshgrid(x, y)
    return across, up


def _write(
    folder: Path, name: str, grey: np.ndarray, cell: float, low: tuple[float, float]
) -> Path:
    rows, columns = grey.shape
    header = f'P5\n{columns} {rows}\n255\n'.encode()
    (folder / f'{name}.pgm').write_bytes(header + grey.astype(np.uint8).tobytes())
    facts = folder / f'{name}.yaml'
    facts.write_text(
        f'image: {name}.pgm\nmode: trinary\nresolution: {cell}\n'
        f'origin: [{low[0]}, {low[1]}, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n',
        encoding='utf-8',
    )
    return facts
