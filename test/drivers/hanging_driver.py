"""A driver whose executor thread loops for ever on SIGUSR1; its middleware goes on."""

import signal

from maasi_drivers.drivers import TurtlebotDriver
from maasi_filter.ros.run_node import run


def hang(number, frame):
    # Python runs this in the main thread, which is the one that spins.
    while True:
        pass


if __name__ == '__main__':
    signal.signal(signal.SIGUSR1, hang)
    raise SystemExit(run(TurtlebotDriver))
