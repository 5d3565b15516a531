"""Exact Poisson multi-Bernoulli mixture (García-Fernández et al., 2018), enumerated on a grid."""

from itertools import product
from math import prod


class ExactPmbm:
    """For targets that stand still; `unseen` (n,) are targets not detected yet in each cell."""

    def __init__(self, unseen):
        self.unseen = unseen
        # Of each hypothesis its weight, and r and density of its components.
        self.hypotheses = [(1.0, [])]

    def update(self, probability, likelihoods, clutter):
        """Take a scan in: pi (n,), g (m, n) at the cells, and the intensity of clutter."""
        masses = [self.unseen * probability * likelihood for likelihood in likelihoods]
        born = [(m.sum() + clutter, (m.sum() / (m.sum() + clutter), m / m.sum())) for m in masses]
        self.unseen = self.unseen * (1.0 - probability)
        found = []
        for weight, components in self.hypotheses:
            options = [self._options(*item, probability, likelihoods) for item in components]
            for choice in product(*options):
                used = [j for j, _, _ in choice if j >= 0]
                if len(set(used)) == len(used):
                    new = [born[j] for j in range(len(born)) if j not in used]
                    factors = [*(item[1] for item in choice), *(item[0] for item in new)]
                    after = [*(item[2] for item in choice), *(item[1] for item in new)]
                    found.append((weight * prod(factors), after))
        total = sum(weight for weight, _ in found)
        self.hypotheses = [(weight / total, components) for weight, components in found]

    @staticmethod
    def _options(r, density, probability, likelihoods):
        """Return what may happen to a component: detection (or -1), factor, what it is then."""
        missed = density * (1.0 - probability)
        factor = 1.0 - r + r * missed.sum()
        options = [(-1, factor, (r * missed.sum() / factor, missed / missed.sum()))]
        for j, likelihood in enumerate(likelihoods):
            seen = density * probability * likelihood
            options.append((j, r * seen.sum(), (1.0, seen / seen.sum())))
        return options

    def density(self):
        return sum(
            weight * r * density
            for weight, components in self.hypotheses
            for r, density in components
        )
