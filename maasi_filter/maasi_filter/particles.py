"""Resampling of weighted particles, and jitter against their degeneracy."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.phd import CHUNK, run_chunks

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True, nogil=True)
def _sum_chunk(weights, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover
    total = 0.0
    for i in range(start, stop):
        total += weights[i]
    return total


def total_weight(weights: FloatArray) -> float:
    """Return the sum of the weights, added in chunks of fixed size, in order."""
    total = 0.0
    for start in range(0, len(weights), CHUNK):
        total += _sum_chunk(weights, start, min(len(weights), start + CHUNK))
    return total


@njit(cache=True, nogil=True)
def _select_chunk(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    weights, start, stop, base, points, first, last, index
):
    """Fill the ancestors of sorted points [first, last) that fall into one chunk of weights."""
    cumulative = base
    point = first
    holder = start
    for i in range(start, stop):
        if weights[i] > 0.0:
            holder = i
            cumulative += weights[i]
            while point < last and points[point] < cumulative:
                index[point] = i
                point += 1
    # Rounding can leave points just behind the last cumulative weight.
    while point < last:
        index[point] = holder
        point += 1


def resampling_points(
    scheme: str, number: int, total: float, generator: np.random.Generator
) -> FloatArray:
    """Return `number` sorted points in [0, total) where the cumulative weights are read.

    `scheme` is 'systematic' (one draw), 'stratified' (one for each stratum) or 'multinomial'
    (independent draws, sorted as ratios of sums of exponential ones).
    """
    if scheme == 'systematic':
        return np.asarray((np.arange(number) + generator.random()) * (total / number), np.float64)
    if scheme == 'stratified':
        return (np.arange(number) + generator.random(number)) * (total / number)
    if scheme == 'multinomial':
        cumulative = np.cumsum(generator.standard_exponential(number + 1))
        return np.asarray(cumulative[:-1] * (total / cumulative[-1]), dtype=float)
    raise ValueError(
        f"resampling: got {scheme!r}, allowed are 'systematic', 'stratified', 'multinomial'"
    )


def resample(
    weights: FloatArray,
    number: int,
    scheme: str,
    generator: np.random.Generator,
    pool: ThreadPoolExecutor | None = None,
) -> IntArray:
    """Return the indices of `number` resampled particles, ascending.

    Parameters
    ----------
    weights : (n,) array
        Not negative, with a positive sum; they need not be normalised.

    Raises
    ------
    ValueError
        If the weights have no positive, finite sum, or the scheme is not known.
    """
    n = len(weights)
    chunks = max(1, -(-n // CHUNK))
    sums = np.empty(chunks)

    def add(chunk: int, start: int, stop: int) -> None:
        sums[chunk] = _sum_chunk(weights, start, stop)

    run_chunks(add, n, pool)
    bases = np.zeros(chunks + 1)
    for chunk in range(chunks):
        bases[chunk + 1] = bases[chunk] + sums[chunk]
    total = float(bases[-1])
    if not (math.isfinite(total) and total > 0.0):
        raise ValueError(f'weights: got a sum of {total}, allowed is a finite number above 0')
    points = resampling_points(scheme, number, total, generator)
    limits = np.searchsorted(points, bases, side='left')
    limits[0] = 0
    # The last chunk that holds any weight takes what rounding puts at the very end.
    limits[int(np.nonzero(sums > 0.0)[0][-1]) + 1 :] = number
    index = np.empty(number, np.int64)

    def select(chunk: int, start: int, stop: int) -> None:
        _select_chunk(
            weights, start, stop, bases[chunk], points, limits[chunk], limits[chunk + 1], index
        )

    run_chunks(select, n, pool)
    return index


@njit(cache=True)
def _mix(state):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return 64 well mixed bits of a counter (splitmix64)."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@njit(cache=True, nogil=True)
def _moments_chunk(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    start, stop, particles, weights, group, references, moments
):
    """Sum weight, and first and second moments about `references`, for each group."""
    d = particles.shape[1]
    offset = np.empty(d)
    for i in range(start, stop):
        weight = weights[i]
        if weight <= 0.0:
            continue
        g = group[i]
        moments[g, 0] += weight
        j = 1 + d
        for a in range(d):
            offset[a] = particles[i, a] - references[g, a]
            moments[g, 1 + a] += weight * offset[a]
            for b in range(a + 1):
                moments[g, j] += weight * offset[a] * offset[b]
                j += 1


def group_moments(
    particles: FloatArray,
    weights: FloatArray,
    group: IntArray,
    groups: int,
    pool: ThreadPoolExecutor | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mass (g,), mean (g, d) and covariance (g, d, d) of each group of particles."""
    n, d = particles.shape
    chunks = max(1, -(-n // CHUNK))
    references = np.zeros((groups, d))
    # A particle of the group as origin keeps the digits of narrow groups far from zero.
    references[group[::-1]] = particles[::-1]
    size = 1 + d + d * (d + 1) // 2
    partial = np.zeros((chunks, groups, size))

    def add(chunk: int, start: int, stop: int) -> None:
        _moments_chunk(start, stop, particles, weights, group, references, partial[chunk])

    run_chunks(add, n, pool)
    moments = np.zeros((groups, size))
    for chunk in range(chunks):
        moments += partial[chunk]
    mass = moments[:, 0]
    safe = np.where(mass > 0.0, mass, 1.0)
    offset = moments[:, 1 : 1 + d] / safe[:, None]
    covariance = np.zeros((groups, d, d))
    j = 1 + d
    for a in range(d):
        for b in range(a + 1):
            value = moments[:, j] / safe - offset[:, a] * offset[:, b]
            covariance[:, a, b] = value
            covariance[:, b, a] = value
            j += 1
    return mass, references + offset, covariance


@njit(cache=True)
def _order(group, groups):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return particle indices sorted by group (stable), and where each group starts."""
    starts = np.zeros(groups + 1, np.int64)
    for i in range(group.shape[0]):
        starts[group[i] + 1] += 1
    for g in range(groups):
        starts[g + 1] += starts[g]
    position = starts[:-1].copy()
    order = np.empty(group.shape[0], np.int64)
    for i in range(group.shape[0]):
        order[position[group[i]]] = i
        position[group[i]] += 1
    return order, starts


@njit(cache=True)
def _count_copies(index, group, groups):  # type: ignore[no-untyped-def]  # pragma: no cover
    copies = np.zeros(groups)
    for i in range(1, index.shape[0]):
        if index[i] == index[i - 1]:
            copies[group[i]] += 1.0
    return copies


@njit(cache=True, nogil=True)
def _jitter_chunk(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    start,
    stop,
    seed,
    index,
    group,
    order,
    starts,
    source,
    means,
    shrink,
    differential,
    deviation,
    fill,
    filled,
    bounds,
    target,
):
    d = source.shape[1]
    # The sum of two uniform numbers on (-1/2, 1/2) has variance 1/6.
    width = deviation * math.sqrt(6.0)
    scale = differential / math.sqrt(2.0)
    for i in range(start, stop):
        g = group[i]
        first = starts[g]
        size = np.uint64(starts[g + 1] - first)
        copied = i > 0 and index[i] == index[i - 1]
        inside = True
        if copied:
            state = seed + np.uint64(0x9E3779B97F4A7C15) * np.uint64(i + 1)
            bits = _mix(state)
            a = order[
                first + np.int64((np.uint64(bits & np.uint64(0xFFFFFFFF)) * size) >> np.uint64(32))
            ]
            b = order[first + np.int64(((bits >> np.uint64(32)) * size) >> np.uint64(32))]
            for axis in range(d):
                moved = source[i, axis] + scale * (source[a, axis] - source[b, axis])
                if width > 0.0:
                    bits = _mix(bits + np.uint64(axis + 1))
                    low = np.float64(bits & np.uint64(0xFFFFFFFF)) * 2.0**-32
                    high = np.float64(bits >> np.uint64(32)) * 2.0**-32
                    moved += width * (low + high - 1.0)
                target[i, axis] = means[g, axis] + shrink[g] * (moved - means[g, axis])
        else:
            for axis in range(d):
                target[i, axis] = means[g, axis] + shrink[g] * (source[i, axis] - means[g, axis])
        if filled[g]:
            bits = _mix(~(seed + np.uint64(0x9E3779B97F4A7C15) * np.uint64(i + 1)))
            for axis in range(d):
                # The sum of four uniform numbers on (-1/2, 1/2) has variance 1/3.
                bits = _mix(bits + np.uint64(axis + 1))
                total = (bits & np.uint64(0xFFFF)) + ((bits >> np.uint64(16)) & np.uint64(0xFFFF))
                total += ((bits >> np.uint64(32)) & np.uint64(0xFFFF)) + (bits >> np.uint64(48))
                normal = (np.float64(total) * 2.0**-16 - 2.0) * math.sqrt(3.0)
                for other in range(d):
                    target[i, other] += fill[g, other, axis] * normal
        for axis in range(d):
            if not bounds[axis, 0] <= target[i, axis] <= bounds[axis, 1]:
                inside = False
        if not inside:
            for axis in range(d):
                target[i, axis] = source[i, axis]


def jitter(
    particles: FloatArray,
    index: IntArray,
    group: IntArray,
    groups: int,
    differential: float,
    deviation: float,
    bounds: FloatArray,
    generator: np.random.Generator,
    keep_covariance: bool = True,
    fill: FloatArray | None = None,
    pool: ThreadPoolExecutor | None = None,
) -> FloatArray:
    """Move the duplicates among resampled particles apart, within their group.

    A duplicate gets x += c / sqrt(2) (x_a - x_b) + noise with x_a, x_b drawn from its group. So
    that this does not widen the group, all of it is drawn in towards its mean to the covariance
    it had, as a shrinkage kernel does (Liu and West, 2001). A particle that would leave the
    bounds stays where it was.

    Parameters
    ----------
    particles : (n, d) array
        Resampled, of equal weights, metres.
    index : (n,) int array
        Their ancestors, ascending: a duplicate is one that has the ancestor of the one before.
    group : (n,) int array
        Group of each, from 0.
    differential : float
        c.
    deviation : float
        Of the noise on each axis, metres; its density is triangular.
    keep_covariance : bool
        Whether to draw in.
    fill : (g, d, d) array, optional
        For each group a root of a covariance: noise of this covariance is added to all of it.
    """
    n, d = particles.shape
    seed = np.uint64(generator.integers(0, 2**63))
    order, starts = _order(group, groups)
    copies = _count_copies(index, group, groups)
    size = np.maximum(starts[1:] - starts[:-1], 1)
    shrink = np.ones(groups)
    means = np.zeros((groups, d))
    if keep_covariance:
        _, means, _ = group_moments(particles, np.ones(n), group, groups, pool)
        shrink = 1.0 / np.sqrt(1.0 + copies / size * differential**2)
    if fill is None:
        fill = np.zeros((groups, d, d))
    filled = fill.reshape(groups, -1).any(axis=1)
    out = np.empty_like(particles)

    def move(_: int, start: int, stop: int) -> None:
        _jitter_chunk(
            start,
            stop,
            seed,
            index,
            group,
            order,
            starts,
            particles,
            means,
            shrink,
            differential,
            deviation,
            fill,
            filled,
            bounds,
            out,
        )

    run_chunks(move, n, pool)
    return out
