"""The factors of a component's density: what each scan tells about its target.

The density is a product of factors, one for each scan since birth (Williams 2015,
with marginal association probabilities):

    f(x) = c_0 (1 - pi(x)) + pi(x) sum_j c_j g(z_j | x)

Factors are rows of numbers, so that one kernel evaluates the product of all of them.
"""

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.geometry.area import density_at
from maasi_filter.geometry.vector_math import arctan2, exponential, use_wide_vectors
from maasi_filter.models.detection import PARAMETERS, fill_probabilities
from maasi_filter.models.measurement import TWO_PI
from maasi_filter.unexplored_map import interpolate_at

ALWAYS = -1  # kind of pi of a factor that is no scan's: 1 everywhere
MOST_PROBABLE = 0.98  # with 1, a single miss would end a component that certainly exists
# An environment is never seen beyond doubt: the model of the sensor is not that good.
LEAST_UNEXPLORED = 1e-3
LEAST_FACTOR = 1e-60  # what a factor is at least

# A head: sensor position, cos and sin of its yaw, kind of pi, c_0, first term, terms, parameters.
SENSOR, COS, SIN, KIND, MISS, FIRST, TERMS, MODEL = 0, 3, 4, 5, 6, 7, 8, 9
HEAD = MODEL + PARAMETERS
# A term: log c_j and the peak of g, whether g is Cartesian, its centre, its information.
SCALE, CARTESIAN, CENTRE, INFORMATION = 0, 1, 2, 5
TERM = INFORMATION + 9


def gaussian_terms(
    centres: FloatArray, covariances: FloatArray, cartesian: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return normal densities as terms (m, TERM), and Cholesky factors of their covariances."""
    number, d = centres.shape
    roots: FloatArray = np.asarray(np.linalg.cholesky(covariances), float)
    information = np.zeros((number, 3, 3))
    information[:, :d, :d] = np.linalg.inv(covariances)
    terms = np.zeros((number, TERM))
    log_roots = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    terms[:, SCALE] = -0.5 * d * math.log(2.0 * math.pi) - log_roots
    terms[:, CARTESIAN] = cartesian
    terms[:, CENTRE : CENTRE + d] = centres
    terms[:, INFORMATION:] = information.reshape(number, 9)
    return terms, roots


def gaussian_factor(mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return head and term of a normal density of positions."""
    head = np.zeros(HEAD)
    head[COS], head[KIND], head[TERMS] = 1.0, ALWAYS, 1
    terms, _ = gaussian_terms(mean[None], covariance[None], np.ones(1, np.bool_))
    return head, terms


@njit(cache=True, error_model='numpy')
def _detection_probabilities(head, axes, offset, probability):  # type: ignore[no-untyped-def]
    """Fill offsets (3, n) of positions (d, n) from a scan's sensor, and pi (n,), capped."""
    number = axes.shape[1]
    for a in range(axes.shape[0]):
        for i in range(number):
            offset[a, i] = axes[a, i] - head[SENSOR + a]
    if head[KIND] == ALWAYS:
        probability[:] = 1.0
        return
    x, y, z = offset[0], offset[1], offset[2]
    kind, cosine, sine = int(head[KIND]), head[COS], head[SIN]
    fill_probabilities(kind, head[MODEL:], x, y, z, cosine, sine, probability)
    for i in range(number):
        probability[i] = min(probability[i], MOST_PROBABLE)


@njit(cache=True, error_model='numpy', fastmath={'contract'})
def _range_and_angles(offset, solid, measured):  # type: ignore[no-untyped-def]
    """Fill range, bearing and elevation (3, n) of offsets; in 2D the elevation is 0."""
    # Rows, not the array, are unpacked: iteration yields strided ones, which are not vectorised.
    x, y, z = offset[0], offset[1], offset[2]
    for i in range(x.shape[0]):
        level = math.sqrt(x[i] * x[i] + y[i] * y[i])
        measured[0, i] = math.sqrt(level * level + z[i] * z[i])
        measured[1, i] = arctan2(y[i], x[i])
        measured[2, i] = arctan2(z[i], level) if solid else 0.0


@njit(cache=True, error_model='numpy', fastmath={'contract'})
def _add_likelihood(term, sensor, origin, factor, out):  # type: ignore[no-untyped-def]
    """Add factor c_j g(z_j | x) (n,); `origin` is measured (3, n), or offsets if Cartesian."""
    use_wide_vectors()
    cartesian = term[CARTESIAN] > 0.5
    shift = sensor if cartesian else np.zeros(3)
    turn = 0.0 if cartesian else 1.0 / TWO_PI
    z0, z1, z2 = term[CENTRE] - shift[0], term[CENTRE + 1] - shift[1], term[CENTRE + 2] - shift[2]
    scale = term[SCALE]
    i00, i01, i02 = term[INFORMATION], term[INFORMATION + 1], term[INFORMATION + 2]
    i11, i12, i22 = term[INFORMATION + 4], term[INFORMATION + 5], term[INFORMATION + 8]
    u, v, w = origin[0], origin[1], origin[2]
    for i in range(out.shape[0]):
        a = u[i] - z0
        b = v[i] - z1
        b -= TWO_PI * np.floor(b * turn + 0.5)
        c = w[i] - z2
        square = a * (a * i00 + 2.0 * (b * i01 + c * i02)) + b * (b * i11 + 2.0 * c * i12)
        out[i] += factor[i] * exponential(scale - 0.5 * (square + c * c * i22))


@njit(cache=True, error_model='numpy')
def add_log_factors(heads, terms, first, last, positions, out):  # type: ignore[no-untyped-def]
    """Add the logs of the factors from `first` to before `last` at positions (n, d) to `out`."""
    number, d = positions.shape
    axes = positions.T.copy()
    # In two dimensions the height of the sensor plays no part.
    offset = np.zeros((3, number))
    measured = np.empty((3, number))
    probability = np.empty(number)
    total = np.empty(number)
    product = np.ones(number)
    for k in range(first, last):
        head = heads[k]
        _detection_probabilities(head, axes, offset, probability)
        for i in range(number):
            total[i] = head[MISS] * (1.0 - probability[i])
        begin = int(head[FIRST])
        end = begin + int(head[TERMS])
        spherical = False
        for j in range(begin, end):
            spherical = spherical or terms[j, CARTESIAN] < 0.5
        if spherical:
            _range_and_angles(offset, d == 3, measured)
        for j in range(begin, end):
            origin = offset if terms[j, CARTESIAN] > 0.5 else measured
            _add_likelihood(terms[j], head[SENSOR : SENSOR + 3], origin, probability, total)
        for i in range(number):
            product[i] *= max(total[i], LEAST_FACTOR)
        # A product of four factors neither overflows nor vanishes; one logarithm serves it.
        if (k - first) % 4 == 3 or k == last - 1:
            for i in range(number):
                out[i] += math.log(product[i])
                product[i] = 1.0


@njit(cache=True, error_model='numpy')
def log_products(heads, terms, prior, frame, positions, products, last):  # type: ignore[no-untyped-def]
    """Fill the log of the prior and of all factors but the last, and that of the last.

    `prior` is e at birth, or empty, and the density of `density_at`; `frame` has lower and upper
    bounds and the step of e.
    """
    grid, cells = prior
    number, d = positions.shape
    for i in range(number):
        products[i] = 0.0
        last[i] = 0.0
        for a in range(d):
            if not frame[0, a] <= positions[i, a] <= frame[1, a]:
                products[i] = -np.inf
        if grid.shape[0]:
            z = positions[i, 2] if d == 3 else 0.0
            unseen = interpolate_at(grid, frame[0], frame[2], positions[i, 0], positions[i, 1], z)
            density = density_at(cells, frame[0], frame[1], positions[i, 0], positions[i, 1])
            products[i] += math.log(max(unseen, LEAST_UNEXPLORED) * density)
    count = heads.shape[0] - 1
    add_log_factors(heads, terms, 0, count, positions, products)
    add_log_factors(heads, terms, count, count + 1, positions, last)


@njit(cache=True, error_model='numpy')
def likelihoods(head, terms, positions, weights, probability, seen, sums):  # type: ignore[no-untyped-def]
    """Fill pi (n,) and pi g_j (m, n) at particles; return p_D = sum w pi.

    `sums` (2, m) becomes sum w pi g_j, and the sum of the squares of w pi g_j.
    """
    number, d = positions.shape
    offset = np.zeros((3, number))
    measured = np.empty((3, number))
    _detection_probabilities(head, positions.T.copy(), offset, probability)
    if terms.shape[0]:
        _range_and_angles(offset, d == 3, measured)
    for j in range(terms.shape[0]):
        origin = offset if terms[j, CARTESIAN] > 0.5 else measured
        seen[j] = 0.0
        _add_likelihood(terms[j], head[SENSOR : SENSOR + 3], origin, probability, seen[j])
        sums[:, j] = 0.0
        for i in range(number):
            share = weights[i] * seen[j, i]
            sums[0, j] += share
            sums[1, j] += share * share
    total = 0.0
    for i in range(number):
        total += weights[i] * probability[i]
    return total


@njit(cache=True, error_model='numpy')
def log_factor(miss, probability, scale, seen, logs):  # type: ignore[no-untyped-def]
    """Fill log(c_0 (1 - pi) + sum c_j pi g_j) (n,) at particles; return its range.

    `probability` is pi (n,), `scale` c_j (m,), and `seen` pi g_j (m, n).
    """
    least = np.inf
    most = -np.inf
    for i in range(len(logs)):
        factor = miss * (1.0 - probability[i])
        for j in range(len(scale)):
            factor += scale[j] * seen[j, i]
        logs[i] = math.log(max(factor, LEAST_FACTOR))
        least = min(least, logs[i])
        most = max(most, logs[i])
    return most - least
