"""Compile the kernels of all packages into the cache, so that no node waits for it."""

from maasi_sim.warm_up import warm_up_all

if __name__ == '__main__':
    warm_up_all()
