"""Domains for runs that are told which to use."""

from contextlib import contextmanager

from maasi_sim.run.domain import DOMAINS, Domain, DomainError


@contextmanager
def reserved_domain():
    """Reserve a domain for a run that is told which to use, and locks it itself.

    It is one of the last, so that no run that takes the first free one gets it.
    """
    for number in reversed(DOMAINS):
        try:
            domain = Domain(number, 'reserved for a test')
        except DomainError:
            continue
        with domain:
            yield domain
        return
    raise DomainError('no ROS domain is left to reserve')
