"""A component's density: particles of iterated batch importance sampling (Chopin 2002)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.models.detection import renew_addresses
from maasi_filter.pmb.factors import (
    CARTESIAN,
    CENTRE,
    FIRST,
    KIND,
    MODEL,
    SENSOR,
    TERMS,
    gaussian_factor,
    log_products,
)

LEAST_EFFECTIVE = 0.4  # below this share of effective particles they are resampled and moved
LEAST_STEP = 1.0 / 64.0  # smallest part of a factor that is taken in at a time
LEAST_EIGENVALUE = 1e-9  # of the mean variance, what each axis has at least
# Moves end when as many are accepted as there are particles, or after so many sweeps.
MOST_SWEEPS = 8
NO_PRIOR = np.empty((0, 0, 0)), np.empty((0, 0))


@njit(cache=True, error_model='numpy')
def _raised(weights, logs, exponent, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Fill w f^exponent, up to a constant; return the sum, and the effective number of these."""
    largest = -np.inf
    for i in range(len(weights)):
        if weights[i] > 0.0:
            largest = max(largest, logs[i])
    total = 0.0
    squares = 0.0
    for i in range(len(weights)):
        out[i] = weights[i] * math.exp(exponent * min(logs[i] - largest, 0.0))
        total += out[i]
        squares += out[i] * out[i]
    return total, total * total / squares


@njit(cache=True, error_model='numpy')
def _exponent(weights, logs, most, least_effective, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the largest exponent up to `most` that leaves enough effective particles."""
    if _raised(weights, logs, most, out)[1] >= least_effective:
        return most
    low = 0.0
    high = most
    for _ in range(20):
        middle = 0.5 * (low + high)
        if _raised(weights, logs, middle, out)[1] >= least_effective:
            low = middle
        else:
            high = middle
    return min(max(low, LEAST_STEP), most)


def _systematic(weights: FloatArray, number: int, start: float) -> IntArray:
    """Return indices of a systematic resampling; `start` is uniform in [0, 1)."""
    points = (np.arange(number) + start) / number
    return np.minimum(np.searchsorted(np.cumsum(weights), points), len(weights) - 1)


@njit(cache=True, error_model='numpy')
def _sweep(heads, terms, prior, frame, exponent, particles, products, last, draws):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Propose moves by differences of two particles of the other half; return how many succeed."""
    number, d = particles.shape
    half = number // 2
    accepted = 0
    for start, end in ((0, half), (half, number)):
        other, size = (half, number - half) if start == 0 else (0, half)
        places = np.empty((end - start, d))
        for i in range(start, end):
            a = other + min(int(draws[i, 0] * size), size - 1)
            b = other + min(int(draws[i, 1] * size), size - 1)
            scale = 2.38 / math.sqrt(2.0 * d) * (0.1 + 0.9 * draws[i, 2])
            for k in range(d):
                places[i - start, k] = particles[i, k] + scale * (particles[a, k] - particles[b, k])
        product = np.empty(end - start)
        newest = np.empty(end - start)
        log_products(heads, terms, prior, frame, places, product, newest)
        for i in range(start, end):
            j = i - start
            gain = product[j] - products[i] + exponent * (newest[j] - last[i])
            if gain >= math.log(max(draws[i, 3], 1e-300)):
                particles[i] = places[j]
                products[i] = product[j]
                last[i] = newest[j]
                accepted += 1
    return accepted


@njit(cache=True, error_model='numpy')
def fill_moments(particles, weights, mean, covariance):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill mean and covariance; return the root mean square distance from the mean."""
    number, d = particles.shape
    trace = 0.0
    for a in range(d):
        mean[a] = 0.0
        for i in range(number):
            mean[a] += weights[i] * particles[i, a]
    for a in range(d):
        for b in range(a + 1):
            total = 0.0
            for i in range(number):
                total += weights[i] * (particles[i, a] - mean[a]) * (particles[i, b] - mean[b])
            covariance[a, b] = total
            covariance[b, a] = total
        trace += covariance[a, a]
    # Particles in one plane still have a covariance that can be inverted.
    least = LEAST_EIGENVALUE * trace / d + 1e-18
    for a in range(d):
        covariance[a, a] += least
    return math.sqrt(trace + d * least)


@dataclass(eq=False)
class Density:
    """Density of one target's position, as particles and as a product of factors."""

    particles: FloatArray  # (n, d): Metres
    weights: FloatArray  # (n,): They sum to 1
    heads: FloatArray  # (k, HEAD): Of the factors, at least one
    terms: FloatArray  # (l, TERM): Of all factors
    #: Factors too, not written to: e at birth (nx, ny, nz), or empty, and the area's `cells`.
    prior: tuple[FloatArray, FloatArray]
    frame: FloatArray  # (3, 3): Lower and upper bounds of the environment, and the step of the grid
    mean: FloatArray = field(init=False)  # (d,): Of the particles
    covariance: FloatArray = field(init=False)  # (d, d)
    radius: float = field(init=False)  # Root mean square distance from the mean, metres

    def __post_init__(self) -> None:
        d = self.particles.shape[1]
        self.mean, self.covariance = np.empty(d), np.empty((d, d))
        # Those of another process, where it is read from a file.
        renew_addresses(self.heads[:, KIND], self.heads[:, MODEL:])
        self._update_moments()

    @classmethod
    def normal(
        cls,
        mean: FloatArray,
        covariance: FloatArray,
        number: int,
        frame: FloatArray,
        generator: np.random.Generator,
    ) -> Density:
        """Return a normal density within the bounds."""
        d = len(mean)
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 1e-12 * max(values.max(), 1e-12)))
        particles = mean + generator.standard_normal((number, d)) @ root.T
        particles = np.clip(particles, frame[0, :d], frame[1, :d])
        head, terms = gaussian_factor(mean, root @ root.T)
        weights = np.full(number, 1.0 / number)
        return cls(particles, weights, head[None], terms, NO_PRIOR, frame)

    def log_at(self, positions: FloatArray) -> FloatArray:
        """Return the log density at positions (n, d); its constant is that of the factors."""
        products, last = self._logs(positions)
        return products + last

    def multiply(
        self, head: FloatArray, terms: FloatArray, logs: FloatArray, generator: np.random.Generator
    ) -> None:
        """Multiply by a factor, whose log at the particles is `logs`."""
        self._append(head, terms)
        changed = np.empty(len(self.weights))
        total, effective = _raised(self.weights, logs, 1.0, changed)
        if effective >= LEAST_EFFECTIVE * len(changed):
            self.weights = changed / total
        else:
            self._temper(generator)
        self._update_moments()

    def restart(
        self,
        head: FloatArray,
        terms: FloatArray,
        particles: FloatArray,
        weights: FloatArray,
        generator: np.random.Generator,
    ) -> None:
        """Multiply by a factor; `particles` with weights are draws from the product already."""
        self._append(head, terms)
        index = _systematic(weights / weights.sum(), len(self.weights), generator.random())
        self.particles = particles[index]
        self.weights = np.full(len(index), 1.0 / len(index))
        products, last = self._logs(self.particles)
        self._move(1.0, products, last, generator)
        self._update_moments()

    def diffuse(self, variance: float, generator: np.random.Generator) -> None:
        """Convolve with a normal density of `variance` [m^2] on each axis: a random walk.

        Particles are moved, so they remain a sample of the true density. Its product of factors is
        replaced by a normal density with their moments, which only Metropolis moves use afterwards.
        """
        noise = generator.standard_normal(self.particles.shape)
        self._shift_particles(math.sqrt(variance) * noise)
        self.condense()

    def thin(self, factor: FloatArray, generator: np.random.Generator) -> None:
        """Multiply by `factor` (n,), given at the particles; factors become a normal density."""
        changed = self.weights * factor
        self.weights = changed / changed.sum()
        if 1.0 / float(self.weights @ self.weights) < LEAST_EFFECTIVE * len(changed):
            index = _systematic(self.weights, len(changed), generator.random())
            self.particles = self.particles[index]
            self.weights = np.full(len(index), 1.0 / len(index))
        self._update_moments()
        self.condense()

    def shift(self, way: FloatArray) -> None:
        """Move the whole density, factors included, by `way` (d,), metres."""
        d = len(way)
        self.heads[:, SENSOR : SENSOR + d] += way
        cartesian = self.terms[:, CARTESIAN] > 0.5
        self.terms[cartesian, CENTRE : CENTRE + d] += way
        self._shift_particles(way)

    def _shift_particles(self, way: FloatArray) -> None:
        d = self.particles.shape[1]
        self.particles = np.clip(self.particles + way, self.frame[0, :d], self.frame[1, :d])
        self._update_moments()

    def condense(self) -> None:
        """Replace all factors by a normal density with the particles' moments."""
        head, self.terms = gaussian_factor(self.mean, self.covariance)
        self.heads = head[None]
        self.prior = NO_PRIOR

    def _append(self, head: FloatArray, terms: FloatArray) -> None:
        head[FIRST], head[TERMS] = len(self.terms), len(terms)
        self.heads = np.concatenate([self.heads, head[None]])
        if len(terms):
            self.terms = np.concatenate([self.terms, terms])

    def _logs(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        products, last = np.empty(len(positions)), np.empty(len(positions))
        log_products(self.heads, self.terms, self.prior, self.frame, positions, products, last)
        return products, last

    def _temper(self, generator: np.random.Generator) -> None:
        """Take the last factor in by parts, with moves after each (Chopin 2002)."""
        products, last = self._logs(self.particles)
        number = len(self.weights)
        changed = np.empty(number)
        taken = 0.0
        while taken < 1.0:
            least = LEAST_EFFECTIVE * number
            step = _exponent(self.weights, last, 1.0 - taken, least, changed)
            taken = 1.0 if taken + step > 1.0 - 1e-9 else taken + step
            total, _ = _raised(self.weights, last, step, changed)
            index = _systematic(changed / total, number, generator.random())
            self.particles = self.particles[index]
            self.weights = np.full(number, 1.0 / number)
            products, last = products[index], last[index]
            self._move(taken, products, last, generator)

    def _move(
        self,
        exponent: float,
        products: FloatArray,
        last: FloatArray,
        generator: np.random.Generator,
    ) -> None:
        number = len(self.weights)
        accepted = 0
        for _ in range(MOST_SWEEPS):
            accepted += _sweep(
                self.heads,
                self.terms,
                self.prior,
                self.frame,
                exponent,
                self.particles,
                products,
                last,
                generator.random((number, 4)),
            )
            if accepted >= number:
                break

    def _update_moments(self) -> None:
        self.radius = fill_moments(self.particles, self.weights, self.mean, self.covariance)
