"""Exact Poisson multi-Bernoulli mixture on a grid by enumeration, for tiny problems.

García-Fernández, Williams, Granström and Svensson (2018): after each scan a weighted set of global
hypotheses, each with a list of Bernoulli components. Densities are numbers at the nodes of a grid.
"""

from __future__ import annotations

import numpy as np


class ExactPmbm:
    """Poisson multi-Bernoulli mixture for targets that stand still.

    Parameters
    ----------
    intensity : (n,) array
        Of targets not detected yet, expected number in each cell.
    """

    def __init__(self, intensity):
        self.unseen = np.array(intensity, float)
        # Of single-target histories: r and density, by a key that names its detections.
        self.single = {}
        self.hypotheses = {(): 1.0}
        self.scan = 0

    def update(self, probability, likelihoods, clutter):
        """Take a scan in: pi (n,), g (m, n) at the cells, and the intensity of clutter."""
        self.scan += 1
        count = len(likelihoods)
        born = []
        for j in range(count):
            mass = self.unseen * probability * likelihoods[j]
            total = mass.sum()
            key = ((self.scan, j),)
            self.single[key] = (total / (total + clutter), mass / total)
            born.append((key, total + clutter))
        self.unseen = self.unseen * (1.0 - probability)
        found = {}
        for hypothesis, weight in self.hypotheses.items():
            options = [self._options(key, probability, likelihoods) for key in hypothesis]
            self._enumerate(options, born, count, (), weight, frozenset(), found)
        total = sum(found.values())
        self.hypotheses = {key: weight / total for key, weight in found.items()}

    def _options(self, key, probability, likelihoods):
        """Return what may happen to a component: detection (or -1), new key, factor."""
        r, density = self.single[key]
        missed = density * (1.0 - probability)
        factor = 1.0 - r + r * missed.sum()
        new = (*key, (self.scan, -1))
        self.single[new] = (r * missed.sum() / factor, missed / missed.sum())
        options = [(-1, new, factor)]
        for j in range(len(likelihoods)):
            seen = density * probability * likelihoods[j]
            new = (*key, (self.scan, j))
            self.single[new] = (1.0, seen / seen.sum())
            options.append((j, new, r * seen.sum()))
        return options

    def _enumerate(self, options, born, count, keys, weight, used, found):
        if weight == 0.0:
            return
        if len(keys) == len(options):
            left = [j for j in range(count) if j not in used]
            for j in left:
                weight *= born[j][1]
            whole = (*keys, *(born[j][0] for j in left))
            found[whole] = found.get(whole, 0.0) + weight
            return
        for j, key, factor in options[len(keys)]:
            if j not in used:
                taken = used | {j} if j >= 0 else used
                self._enumerate(options, born, count, (*keys, key), weight * factor, taken, found)

    def density(self):
        """Return the expected number of detected targets in each cell."""
        total = np.zeros(len(self.unseen))
        for hypothesis, weight in self.hypotheses.items():
            for key in hypothesis:
                r, density = self.single[key]
                total += weight * r * density
        return total
