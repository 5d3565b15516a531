"""Resampling of weighted particles, and jitter against their degeneracy."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.phd import CHUNK, finish_moments, run_chunks

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True, nogil=True, error_model='numpy')
def _sum_chunks(first_chunk, last_chunk, weights, sums):  # type: ignore[no-untyped-def]  # pragma: no cover
    for chunk in range(first_chunk, last_chunk):
        total = 0.0
        for i in range(chunk * CHUNK, min(weights.shape[0], (chunk + 1) * CHUNK)):
            total += weights[i]
        sums[chunk] = total


def total_weight(weights: FloatArray) -> float:
    """Return the sum of the weights, added in chunks of fixed size, in order."""
    chunks = -(-len(weights) // CHUNK)
    sums = np.empty(chunks)
    _sum_chunks(0, chunks, weights, sums)
    total = 0.0
    for part in sums.tolist():
        total += part
    return total


@njit(cache=True, nogil=True, error_model='numpy')
def _select_chunks(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    first_chunk, last_chunk, weights, bases, points, limits, index
):
    """Fill the ancestors of the sorted points that fall into chunks of weights."""
    for chunk in range(first_chunk, last_chunk):
        cumulative = bases[chunk]
        point = limits[chunk]
        last = limits[chunk + 1]
        start = chunk * CHUNK
        stop = min(weights.shape[0], start + CHUNK)
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

    run_chunks(lambda c, e: _sum_chunks(c, e, weights, sums), n, pool)
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

    run_chunks(lambda c, e: _select_chunks(c, e, weights, bases, points, limits, index), n, pool)
    return index


@njit(cache=True, error_model='numpy')
def _mix(state):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return 64 well mixed bits of a counter (splitmix64)."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@njit(cache=True, nogil=True, error_model='numpy')
def _gather_chunks(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    first_chunk, last_chunk, index, particles, group, compact, out, out_group
):
    d = particles.shape[1]
    for i in range(first_chunk * CHUNK, min(index.shape[0], last_chunk * CHUNK)):
        j = index[i]
        for a in range(d):
            out[i, a] = particles[j, a]
        out_group[i] = compact[group[j]]


def gather(
    index: IntArray,
    particles: FloatArray,
    group: IntArray,
    groups: int,
    pool: ThreadPoolExecutor | None = None,
) -> tuple[FloatArray, IntArray, NDArray[np.bool_]]:
    """Return the chosen particles, their groups renumbered from 0, and which groups are left."""
    present = np.zeros(groups, np.bool_)
    _mark_present(index, group, present)
    compact = np.cumsum(present) - 1
    out = np.empty((len(index), particles.shape[1]))
    out_group = np.empty(len(index), np.int64)
    run_chunks(
        lambda c, e: _gather_chunks(c, e, index, particles, group, compact, out, out_group),
        len(index),
        pool,
    )
    return out, out_group, present


@njit(cache=True, error_model='numpy')
def _mark_present(index, group, present):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(index.shape[0]):
        present[group[index[i]]] = True


@njit(cache=True, error_model='numpy')
def _references(particles, group, references):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the first particle of each group."""
    for i in range(particles.shape[0] - 1, -1, -1):
        for a in range(particles.shape[1]):
            references[group[i], a] = particles[i, a]


@njit(cache=True, nogil=True, error_model='numpy')
def _moments_chunks(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    first_chunk, last_chunk, particles, weights, group, references, all_moments
):
    """Sum weight, and first and second moments about `references`, for each group."""
    d = particles.shape[1]
    for chunk in range(first_chunk, last_chunk):
        i = chunk * CHUNK
        stop = min(particles.shape[0], i + CHUNK)
        while i < stop:
            # Particles of a group lie together: each run is summed by itself.
            g = group[i]
            c0 = references[g, 0]
            c1 = references[g, 1]
            c2 = references[g, 2] if d == 3 else 0.0
            t0 = 0.0
            tx = 0.0
            ty = 0.0
            tz = 0.0
            txx = 0.0
            txy = 0.0
            tyy = 0.0
            txz = 0.0
            tyz = 0.0
            tzz = 0.0
            while i < stop and group[i] == g:
                weight = weights[i]
                x = particles[i, 0] - c0
                y = particles[i, 1] - c1
                t0 += weight
                tx += weight * x
                ty += weight * y
                txx += weight * x * x
                txy += weight * x * y
                tyy += weight * y * y
                if d == 3:
                    z = particles[i, 2] - c2
                    tz += weight * z
                    txz += weight * x * z
                    tyz += weight * y * z
                    tzz += weight * z * z
                i += 1
            moments = all_moments[chunk, g]
            moments[0] += t0
            moments[1] += tx
            moments[2] += ty
            if d == 2:
                moments[3] += txx
                moments[4] += txy
                moments[5] += tyy
            else:
                moments[3] += tz
                moments[4] += txx
                moments[5] += txy
                moments[6] += tyy
                moments[7] += txz
                moments[8] += tyz
                moments[9] += tzz


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
    # A particle of the group as origin keeps the digits of narrow groups far from zero.
    references = np.zeros((groups, d))
    _references(particles, group, references)
    partial = np.zeros((chunks, groups, 1 + d + d * (d + 1) // 2))
    run_chunks(
        lambda c, e: _moments_chunks(c, e, particles, weights, group, references, partial), n, pool
    )
    mass = np.empty(groups)
    means = np.empty((groups, d))
    covariances = np.empty((groups, d, d))
    finish_moments(partial, references, mass, means, covariances)
    return mass, means, covariances


@njit(cache=True, error_model='numpy')
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


@njit(cache=True, error_model='numpy')
def _count_copies(index, group, copies):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(1, index.shape[0]):
        if index[i] == index[i - 1]:
            copies[group[i]] += 1.0


@njit(cache=True, nogil=True, error_model='numpy')
def _jitter_chunks(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    first_chunk,
    last_chunk,
    seed,
    index,
    group,
    order,
    starts,
    source,
    means,
    shrink,
    scale,
    deviation,
    fill,
    filled,
    bounds,
    target,
):
    d = source.shape[1]
    # The sum of two uniform numbers on (-1/2, 1/2) has variance 1/6.
    width = deviation * math.sqrt(6.0)
    low_half = np.uint64(0xFFFFFFFF)
    quarter = np.uint64(0xFFFF)
    for i in range(first_chunk * CHUNK, min(source.shape[0], last_chunk * CHUNK)):
        g = group[i]
        state = seed + np.uint64(0x9E3779B97F4A7C15) * np.uint64(i + 1)
        if i > 0 and index[i] == index[i - 1]:
            first = starts[g]
            size = np.uint64(starts[g + 1] - first)
            bits = _mix(state)
            a = order[first + np.int64(((bits & low_half) * size) >> np.uint64(32))]
            b = order[first + np.int64(((bits >> np.uint64(32)) * size) >> np.uint64(32))]
            for axis in range(d):
                moved = source[i, axis] + scale[g] * (source[a, axis] - source[b, axis])
                if width > 0.0:
                    bits = _mix(bits + np.uint64(axis + 1))
                    low = np.float64(np.int64(bits & low_half)) * 2.0**-32
                    high = np.float64(np.int64(bits >> np.uint64(32))) * 2.0**-32
                    moved += width * (low + high - 1.0)
                target[i, axis] = means[g, axis] + shrink[g] * (moved - means[g, axis])
        else:
            for axis in range(d):
                target[i, axis] = means[g, axis] + shrink[g] * (source[i, axis] - means[g, axis])
        if filled[g]:
            bits = _mix(~state)
            for axis in range(d):
                # The sum of four uniform numbers on (-1/2, 1/2) has variance 1/3.
                bits = _mix(bits + np.uint64(axis + 1))
                total = (bits & quarter) + ((bits >> np.uint64(16)) & quarter)
                total += ((bits >> np.uint64(32)) & quarter) + (bits >> np.uint64(48))
                normal = (np.float64(np.int64(total)) * 2.0**-16 - 2.0) * math.sqrt(3.0)
                for other in range(d):
                    target[i, other] += fill[g, other, axis] * normal
        inside = True
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
    means: FloatArray,
    differential: FloatArray,
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
    bounds stays where it was. Random numbers are hashes of a particle's index and one draw of the
    generator, so that they do not depend on the order of the work.

    Parameters
    ----------
    particles : (n, d) array
        Resampled, of equal weights, metres.
    index : (n,) int array
        Their ancestors, ascending: a duplicate is one that has the ancestor of the one before.
    group : (n,) int array
        Group of each, from 0.
    means : (g, d) array
        Of the groups, metres.
    differential : (g,) array
        c, for each group.
    deviation : float
        Of the noise on each axis, metres; its density is triangular.
    keep_covariance : bool
        Whether to draw in.
    fill : (g, d, d) array, optional
        For each group a root of a covariance: noise of this covariance is added to all of it.
    """
    groups, d = means.shape
    seed = np.uint64(generator.integers(0, 2**63))
    order, starts = _order(group, groups)
    scale = differential / math.sqrt(2.0)
    shrink = np.ones(groups)
    if keep_covariance:
        copies = np.zeros(groups)
        _count_copies(index, group, copies)
        size = np.maximum(starts[1:] - starts[:-1], 1)
        shrink = 1.0 / np.sqrt(1.0 + copies / size * differential**2)
    if fill is None:
        fill = np.zeros((groups, d, d))
    filled = fill.reshape(groups, d * d).any(axis=1)
    out = np.empty_like(particles)
    run_chunks(
        lambda c, e: _jitter_chunks(
            c,
            e,
            seed,
            index,
            group,
            order,
            starts,
            particles,
            means,
            shrink,
            scale,
            deviation,
            fill,
            filled,
            bounds,
            out,
        ),
        len(particles),
        pool,
    )
    return out
