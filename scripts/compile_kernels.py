"""Compile the kernels of all packages into the cache, so that no node waits for it."""

import maasi_drivers.warm_up
import maasi_filter
import maasi_planner
import maasi_sim.warm_up


def main() -> None:
    maasi_filter.warm_up()
    maasi_planner.warm_up()
    maasi_drivers.warm_up.warm_up()
    maasi_sim.warm_up.warm_up()


if __name__ == '__main__':
    main()
