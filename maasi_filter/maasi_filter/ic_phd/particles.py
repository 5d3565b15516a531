"""Resampling of weighted particles, and jitter against their degeneracy."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.ic_phd.phd import CHUNK, SUMS, Workspace, add_moments, finish_moments, run_chunks
from maasi_filter.models.detection import offsets

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True, nogil=True, error_model='numpy', fastmath=SUMS)
def _sum_chunks(first_chunk, last_chunk, weights, sums):  # type: ignore[no-untyped-def]
    for chunk in range(first_chunk, last_chunk):
        part = weights[chunk * CHUNK : (chunk + 1) * CHUNK]
        total = 0.0
        for i in range(len(part)):
            total += part[i]
        sums[chunk] = total


def total_weight(weights: FloatArray, pool: ThreadPoolExecutor | None = None) -> float:
    """Return the sum of the weights, added in chunks of fixed size, in order."""
    sums = np.empty(-(-len(weights) // CHUNK))
    if len(sums):
        run_chunks(lambda c, e: _sum_chunks(c, e, weights, sums), len(weights), pool)
    total = 0.0
    for part in sums.tolist():
        total += part
    return total


@njit(cache=True, nogil=True, error_model='numpy')
def _select_chunks(  # type: ignore[no-untyped-def]
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


@njit(cache=True, nogil=True, error_model='numpy')
def _select_evenly_chunks(  # type: ignore[no-untyped-def]
    first_chunk, last_chunk, weights, bases, rate, offset, limits, index
):
    """Fill the ancestors of points (k + offset) / rate, without the points."""
    cumulative = np.empty(CHUNK)
    for chunk in range(first_chunk, last_chunk):
        start = chunk * CHUNK
        part = weights[start : start + CHUNK]
        size = len(part)
        total = bases[chunk]
        for i in range(size):
            total += part[i]
            cumulative[i] = total
        for i in range(size):
            cumulative[i] = np.ceil(cumulative[i] * rate - offset)
        point = limits[chunk]
        last = limits[chunk + 1]
        holder = start
        for i in range(size):
            reached = min(np.int64(cumulative[i]), last)
            # Four at a time, needed or not: what is too much is overwritten, and few guesses of
            # the processor at the number of copies go wrong.
            if point + 4 <= last:
                index[point] = start + i
                index[point + 1] = start + i
                index[point + 2] = start + i
                index[point + 3] = start + i
                while point + 4 < reached:
                    point += 4
                    for k in range(point, min(point + 4, last)):
                        index[k] = start + i
                point = max(point, reached)
            while point < reached:
                index[point] = start + i
                point += 1
            holder = start + i if part[i] > 0.0 else holder
        # Rounding can leave points just behind the last cumulative weight.
        while point < last:
            index[point] = holder
            point += 1


@njit(cache=True, error_model='numpy')
def _evenly_limits(sums, number, offset, bases, limits):  # type: ignore[no-untyped-def]
    """Fill which points (k + offset) total / number fall into each chunk, and sums up to it.

    The last chunk that holds any weight takes what rounding puts at the very end.
    """
    chunks = sums.shape[0]
    end = 0
    bases[0] = 0.0
    for chunk in range(chunks):
        bases[chunk + 1] = bases[chunk] + sums[chunk]
        if sums[chunk] > 0.0:
            end = chunk + 1
    rate = number / bases[chunks]
    limits[0] = 0
    for chunk in range(1, chunks + 1):
        limit = np.int64(np.ceil(bases[chunk] * rate - offset))
        limits[chunk] = number if chunk >= end else min(max(limit, 0), number)
    return rate


def resampling_points(
    scheme: str, number: int, total: float, generator: np.random.Generator
) -> FloatArray:
    """Return `number` sorted points in [0, total) where the cumulative weights are read.

    `scheme` is 'stratified' (one draw for each stratum) or 'multinomial' (independent draws,
    sorted as ratios of sums of exponential ones).
    """
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
    total = sum(sums.tolist())
    if not (math.isfinite(total) and total > 0.0):
        raise ValueError(f'weights: got a sum of {total}, allowed is a finite number above 0')
    index = np.empty(number, np.int64)
    bases = np.empty(chunks + 1)
    if scheme == 'systematic':
        offset = generator.random()
        limits = np.empty(chunks + 1, np.int64)
        rate = _evenly_limits(sums, number, offset, bases, limits)
        run_chunks(
            lambda c, e: _select_evenly_chunks(c, e, weights, bases, rate, offset, limits, index),
            n,
            pool,
        )
        return index
    bases[0] = 0.0
    np.cumsum(sums, out=bases[1:])
    # The last chunk that holds any weight takes what rounding puts at the very end.
    end = int(np.nonzero(sums > 0.0)[0][-1]) + 1
    points = resampling_points(scheme, number, float(bases[-1]), generator)
    limits = np.searchsorted(points, bases, side='left')
    limits[0] = 0
    limits[end:] = number
    run_chunks(lambda c, e: _select_chunks(c, e, weights, bases, points, limits, index), n, pool)
    return index


@njit(cache=True, error_model='numpy')
def _mix(state):  # type: ignore[no-untyped-def]
    """Return 64 well mixed bits of a counter (splitmix64)."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@njit(cache=True, nogil=True, error_model='numpy')
def _count_chunks(first_chunk, last_chunk, index, group, counts):  # type: ignore[no-untyped-def]
    for chunk in range(first_chunk, last_chunk):
        part = index[chunk * CHUNK : (chunk + 1) * CHUNK]
        here = counts[chunk]
        for k in range(len(part)):
            here[group[part[k]]] += 1


@njit(cache=True, error_model='numpy')
def _place(counts, present, starts):  # type: ignore[no-untyped-def]
    """Replace counts by where each chunk's part of a group begins; return the number of groups."""
    position = 0
    left = 0
    for g in range(counts.shape[1]):
        begin = position
        for chunk in range(counts.shape[0]):
            number = counts[chunk, g]
            counts[chunk, g] = position
            position += number
        present[g] = position > begin
        if position > begin:
            starts[left] = begin
            left += 1
    starts[left] = position
    return left


@njit(cache=True, nogil=True, error_model='numpy')
def _gather_chunks(  # type: ignore[no-untyped-def]
    first_chunk, last_chunk, index, particles, group, places, out, copy
):
    d = particles.shape[1]
    flat = particles.reshape(particles.size)
    flat_out = out.reshape(out.size)
    for chunk in range(first_chunk, last_chunk):
        first = chunk * CHUNK
        stop = min(index.shape[0], first + CHUNK)
        before = index[first - 1] if first > 0 else -1
        here = places[chunk]
        for k in range(first, stop):
            chosen = index[k]
            g = group[chosen]
            place = here[g]
            here[g] = place + 1
            copy[place] = chosen == before
            before = chosen
            source = d * chosen
            target = d * place
            flat_out[target] = flat[source]
            flat_out[target + 1] = flat[source + 1]
            if d == 3:
                flat_out[target + 2] = flat[source + 2]


def gather(
    index: IntArray,
    particles: FloatArray,
    group: IntArray,
    groups: int,
    pool: ThreadPoolExecutor | None = None,
    workspace: Workspace | None = None,
) -> tuple[FloatArray, NDArray[np.bool_], IntArray, NDArray[np.bool_]]:
    """Return the chosen particles, group after group, and what belongs to them.

    Parameters
    ----------
    index : (n,) int array
        Chosen particles, ascending.
    workspace : Workspace, optional
        The arrays of n in the result are its own.

    Returns
    -------
    particles : (n, d) array
    copy : (n,) bool array
        Whether the one before in the group is the same particle.
    starts : (g + 1,) int array
        Where each group that is left starts, and the end.
    present : (groups,) bool array
        Which groups are left.
    """
    workspace = Workspace() if workspace is None else workspace
    n = len(index)
    places = np.zeros((max(1, -(-n // CHUNK)), groups), np.int64)
    run_chunks(lambda c, e: _count_chunks(c, e, index, group, places), n, pool)
    present = np.empty(groups, np.bool_)
    starts = np.empty(groups + 1, np.int64)
    left = _place(places, present, starts)
    out = workspace.take('gathered', (n, particles.shape[1]))
    copy = workspace.take('copy', (n,), np.bool_)
    run_chunks(
        lambda c, e: _gather_chunks(c, e, index, particles, group, places, out, copy), n, pool
    )
    return out, copy, starts[: left + 1], present


@njit(cache=True, error_model='numpy')
def _references(particles, group, references):  # type: ignore[no-untyped-def]
    """Fill the first particle of each group."""
    missing = references.shape[0]
    seen = np.zeros(missing, np.bool_)
    for i in range(particles.shape[0]):
        if not seen[group[i]]:
            seen[group[i]] = True
            for a in range(particles.shape[1]):
                references[group[i], a] = particles[i, a]
            missing -= 1
            if missing == 0:
                break


@njit(cache=True, nogil=True, error_model='numpy')
def _moments_chunks(  # type: ignore[no-untyped-def]
    first_chunk, last_chunk, particles, weights, group, references, all_moments
):
    """Sum weight, and first and second moments about `references`, for each group."""
    x = np.empty(CHUNK)
    y = np.empty(CHUNK)
    z = np.empty(CHUNK)
    origin = np.zeros(3)
    for chunk in range(first_chunk, last_chunk):
        first = chunk * CHUNK
        stop = min(particles.shape[0], first + CHUNK)
        while first < stop:
            # Particles of a group lie together: each run is summed by itself.
            g = group[first]
            last = first
            while last < stop and group[last] == g:
                last += 1
            offsets(particles, first, last - first, origin, x, y, z)
            add_moments(
                weights[first:last],
                x,
                y,
                z,
                last - first,
                references[g],
                particles.shape[1] == 3,
                all_moments[chunk, g],
            )
            first = last


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


@njit(cache=True, nogil=True, error_model='numpy')
def _clear_chunks(  # type: ignore[no-untyped-def]
    first_chunk, last_chunk, particles, weights, group, centre, square, here, groups
):
    first = first_chunk * CHUNK
    stop = min(weights.shape[0], last_chunk * CHUNK)
    part = weights[first:stop]
    groups_here = group[first:stop]
    x = centre[0]
    y = centre[1]
    if particles.shape[1] == 3:
        z = centre[2]
        flat = particles[first:stop].reshape(3 * (stop - first))
        for i in range(stop - first):
            a = flat[3 * i] - x
            b = flat[3 * i + 1] - y
            c = flat[3 * i + 2] - z
            near = (a * a + b * b + c * c <= square) & (groups_here[i] < groups)
            part[i] = 0.0 if near | (groups_here[i] == here) else part[i]
    else:
        flat = particles[first:stop].reshape(2 * (stop - first))
        for i in range(stop - first):
            a = flat[2 * i] - x
            b = flat[2 * i + 1] - y
            near = (a * a + b * b <= square) & (groups_here[i] < groups)
            part[i] = 0.0 if near | (groups_here[i] == here) else part[i]


def clear(
    particles: FloatArray,
    weights: FloatArray,
    group: IntArray,
    centre: FloatArray,
    radius: float,
    here: int,
    groups: int,
    pool: ThreadPoolExecutor | None = None,
) -> None:
    """Set to 0, in place, the weights of one group, and of others around it.

    Parameters
    ----------
    centre : (d,) array
        Metres.
    radius : float
        Of those around, metres.
    here : int
        The group.
    groups : int
        Only groups below this one are others.
    """
    run_chunks(
        lambda c, e: _clear_chunks(
            c, e, particles, weights, group, centre, radius * radius, here, groups
        ),
        len(weights),
        pool,
    )


@njit(cache=True, nogil=True, error_model='numpy')
def _fill_groups_chunks(first_chunk, last_chunk, starts, group):  # type: ignore[no-untyped-def]
    first = first_chunk * CHUNK
    stop = min(group.shape[0], last_chunk * CHUNK)
    g = np.searchsorted(starts, first, side='right') - 1
    while first < stop:
        last = min(starts[g + 1], stop)
        for i in range(first, last):
            group[i] = g
        first = last
        g += 1


def groups_of(starts: IntArray, pool: ThreadPoolExecutor | None = None) -> IntArray:
    """Return the group (n,) of each of n particles that lie group after group."""
    group = np.empty(int(starts[-1]), np.int64)
    run_chunks(lambda c, e: _fill_groups_chunks(c, e, starts, group), len(group), pool)
    return group


@njit(cache=True, error_model='numpy')
def _shrinkage(copy, starts, differential, shrink):  # type: ignore[no-untyped-def]
    for g in range(shrink.shape[0]):
        copies = 0
        for i in range(starts[g], starts[g + 1]):
            copies += np.int64(copy[i])
        size = max(starts[g + 1] - starts[g], 1)
        shrink[g] = 1.0 / math.sqrt(1.0 + copies / size * differential[g] * differential[g])


@njit(cache=True, error_model='numpy')
def _draw_in(source, mean, share, number, target):  # type: ignore[no-untyped-def]
    x = mean[0]
    y = mean[1]
    for i in range(number):
        target[i, 0] = x + share * (source[i, 0] - x)
        target[i, 1] = y + share * (source[i, 1] - y)


@njit(cache=True, error_model='numpy')
def _draw_in_solid(source, mean, share, number, target):  # type: ignore[no-untyped-def]
    x = mean[0]
    y = mean[1]
    z = mean[2]
    for i in range(number):
        target[i, 0] = x + share * (source[i, 0] - x)
        target[i, 1] = y + share * (source[i, 1] - y)
        target[i, 2] = z + share * (source[i, 2] - z)


@njit(cache=True, error_model='numpy')
def _copies(copy, first, last, copies):  # type: ignore[no-untyped-def]
    """Fill which particles of [first, last) are copies; return their number."""
    number = np.int64(0)
    for k in range(first, last):
        copies[number] = k
        number += np.int64(copy[k])
    return number


@njit(cache=True, error_model='numpy')
def _move(  # type: ignore[no-untyped-def]
    source, copies, number, ones, others, noise, scale, width, drawn, target
):
    d = source.shape[1]
    flat = source.reshape(source.size)
    moved = target.reshape(target.size)
    for j in range(number):
        k = d * copies[j]
        a = d * ones[j]
        b = d * others[j]
        moved[k] += drawn * (scale * (flat[a] - flat[b]) + width * noise[0, j])
        moved[k + 1] += drawn * (scale * (flat[a + 1] - flat[b + 1]) + width * noise[1, j])
        if d == 3:
            moved[k + 2] += drawn * (scale * (flat[a + 2] - flat[b + 2]) + width * noise[2, j])


@njit(cache=True, error_model='numpy')
def _random_moves(  # type: ignore[no-untyped-def]
    seed, copies, number, first, stop, ones, others, noise
):
    """Fill for the first `number` of `copies` two random particles of [first, stop), and noise.

    The noise (3, number) is on (-1, 1), of triangular density.
    """
    low_half = np.uint64(0xFFFFFFFF)
    fifth = np.uint64(0x3FF)
    size = np.uint64(stop - first)
    for j in range(number):
        bits = _mix(seed + np.uint64(0x9E3779B97F4A7C15) * np.uint64(copies[j] + 1))
        ones[j] = first + np.int64(((bits & low_half) * size) >> np.uint64(32))
        others[j] = first + np.int64(((bits >> np.uint64(32)) * size) >> np.uint64(32))
        bits = _mix(bits)
        # Two numbers of ten bits for each axis.
        for axis in range(3):
            total = (bits & fifth) + ((bits >> np.uint64(10)) & fifth)
            bits = bits >> np.uint64(20)
            noise[axis, j] = (np.float64(np.int64(total)) + 1.0) * 2.0**-10 - 1.0


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _any_outside(positions, lower, upper):  # type: ignore[no-untyped-def]
    x0, x1 = lower[0], upper[0]
    y0, y1 = lower[1], upper[1]
    z0, z1 = lower[2], upper[2]
    # How far beyond the bounds any is, negative inside: no branch for each particle.
    most = -np.inf
    if positions.shape[1] == 3:
        for i in range(positions.shape[0]):
            x = max(x0 - positions[i, 0], positions[i, 0] - x1)
            y = max(y0 - positions[i, 1], positions[i, 1] - y1)
            z = max(z0 - positions[i, 2], positions[i, 2] - z1)
            most = max(most, max(x, max(y, z)))
    else:
        for i in range(positions.shape[0]):
            x = max(x0 - positions[i, 0], positions[i, 0] - x1)
            y = max(y0 - positions[i, 1], positions[i, 1] - y1)
            most = max(most, max(x, y))
    return most > 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def _jitter_chunks(  # type: ignore[no-untyped-def]
    first_chunk,
    last_chunk,
    seed,
    copy,
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
    quarter = np.uint64(0xFFFF)
    lower = np.zeros(3)
    upper = np.zeros(3)
    for axis in range(d):
        lower[axis] = bounds[axis, 0]
        upper[axis] = bounds[axis, 1]
    copies = np.empty(CHUNK, np.int64)
    ones = np.empty(CHUNK, np.int64)
    others = np.empty(CHUNK, np.int64)
    noise = np.empty((3, CHUNK))
    i = first_chunk * CHUNK
    stop = min(source.shape[0], last_chunk * CHUNK)
    g = np.searchsorted(starts, i, side='right') - 1
    while i < stop:
        begin = i
        last = min(starts[g + 1], stop, begin + CHUNK)
        scale = differential[g] / math.sqrt(2.0)
        drawn = shrink[g]
        here = source[begin:last]
        there = target[begin:last]
        if d == 3:
            _draw_in_solid(here, means[g], drawn, last - begin, there)
        else:
            _draw_in(here, means[g], drawn, last - begin, there)
        number = _copies(copy, begin, last, copies)
        _random_moves(seed, copies, number, starts[g], starts[g + 1], ones, others, noise)
        _move(source, copies, number, ones, others, noise, scale, width, drawn, target)
        if filled[g]:
            for k in range(begin, last):
                bits = _mix(~(seed + np.uint64(0x9E3779B97F4A7C15) * np.uint64(k + 1)))
                for axis in range(d):
                    # The sum of four uniform numbers on (-1/2, 1/2) has variance 1/3.
                    bits = _mix(bits + np.uint64(axis + 1))
                    total = (bits & quarter) + ((bits >> np.uint64(16)) & quarter)
                    total += ((bits >> np.uint64(32)) & quarter) + (bits >> np.uint64(48))
                    normal = (np.float64(np.int64(total)) * 2.0**-16 - 2.0) * math.sqrt(3.0)
                    for other in range(d):
                        target[k, other] += fill[g, other, axis] * normal
        if _any_outside(there, lower, upper):
            for k in range(begin, last):
                inside = True
                for axis in range(d):
                    inside = inside and lower[axis] <= target[k, axis] <= upper[axis]
                if not inside:
                    for axis in range(d):
                        target[k, axis] = source[k, axis]
        i = last
        if i == starts[g + 1]:
            g += 1


def jitter(
    particles: FloatArray,
    copy: NDArray[np.bool_],
    starts: IntArray,
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
        Resampled, of equal weights, group after group, metres.
    copy : (n,) bool array
        Which of them are duplicates of the one before.
    starts : (g + 1,) int array
        Where each group starts, and the end.
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
    shrink = np.ones(groups)
    if keep_covariance:
        _shrinkage(copy, starts, differential, shrink)
    filled = np.zeros(groups, np.bool_)
    if fill is None:
        fill = np.zeros((groups, d, d))
    else:
        fill.reshape(groups, d * d).any(axis=1, out=filled)
    out = np.empty_like(particles)
    run_chunks(
        lambda c, e: _jitter_chunks(
            c,
            e,
            seed,
            copy,
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
        ),
        len(particles),
        pool,
    )
    return out
