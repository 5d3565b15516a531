"""A command that measures how fast a Mambo flies at its largest tilt: `mambo.full_speed`."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time

from maasi_drivers.links.mambo.link import MamboLink, MamboLinkError
from maasi_drivers.links.mambo.settings import LEAST_TILT, MOST_TILT
from maasi_drivers.links.mambo.speed_measurement import MeasurementError, MeasuringFlight, fit_speed

_PERIOD = 0.05
# Longest wait for it to land [s].
_LANDING = 15.0
_INTERRUPTED = 'interrupted'


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='measure_mambo',
        description='Have a Mambo take off, tilt forward and backward some times, and land; print '
        'mambo.full_speed and mambo.delay for its driver. Ctrl-C lands it.',
    )
    parser.add_argument(
        '--fly', action='store_true', help='without it nothing takes off: it says what it would do'
    )
    parser.add_argument(
        '--address', default='192.168.99.3', help='of the drone (default: %(default)s)'
    )
    parser.add_argument('--bluetooth', action='store_true', help='instead of WiFi')
    parser.add_argument(
        '--port', type=int, default=43210, help='on which it is heard (default: %(default)s)'
    )
    parser.add_argument(
        '--tilt',
        type=float,
        default=0.1,
        metavar='RAD',
        help='the largest, motion.tilt of its driver [rad] (default: %(default)s)',
    )
    parser.add_argument(
        '--way',
        type=float,
        default=1.0,
        metavar='M',
        help='it keeps within this forward and backward of where it stands, and needs half of it '
        'more to be safe [m] (default: %(default)s)',
    )
    parser.add_argument('--legs', type=int, default=6, metavar='N', help='(default: %(default)s)')
    return parser


def _problem(options: argparse.Namespace) -> str:
    """Return what is wrong with the options, or nothing."""
    for name, low, high in (
        ('tilt', LEAST_TILT, MOST_TILT),
        ('way', 0.5, 10.0),
        ('legs', 2, 50),
        ('port', 1024, 65535),
    ):
        value = getattr(options, name)
        if not low <= value <= high:
            return f'--{name}: read {value:g}, allowed is {low:.4g} to {high:.4g}'
    return ''


def _measure(link: MamboLink, options: argparse.Namespace, ended: threading.Event) -> str:
    """Fly and print the result; return what went wrong, or nothing."""
    flight = MeasuringFlight(link, options.way, options.legs, time.monotonic)
    said = ''
    try:
        for what in flight.steps():
            if what != said:
                said = what
                print(what, flush=True)
            if ended.wait(_PERIOD):
                return _INTERRUPTED
    except MeasurementError as error:
        return str(error)
    finally:
        _land(link)
    try:
        found = fit_speed(flight.legs, link.tilt)
    except MeasurementError as error:
        return str(error)
    print(
        f'\nmotion.tilt: {link.tilt:g}\n'
        f'mambo.full_speed: {found.full_speed:.3g}    # m/s, to {100 * found.doubt:.1f} per cent\n'
        f'mambo.delay: {found.delay:.2f}    # s'
    )
    return ''


def _land(link: MamboLink) -> None:
    end = time.monotonic() + _LANDING
    while link.connected and link.flying_state != 'landed' and time.monotonic() < end:
        link.keep_alive()
        link.land()
        time.sleep(_PERIOD)
    if link.airborne:
        print('error: the drone has not said that it landed', file=sys.stderr)


def main(arguments: list[str] | None = None) -> int:
    """Run the measurement and return its exit code."""
    options = build_parser().parse_args(arguments)
    problem = _problem(options)
    if problem:
        print(f'error: {problem}', file=sys.stderr)
        return 2
    if not options.fly:
        print(
            f'It would take off and fly {options.legs} legs of at most {options.way:g} m forward '
            f'and backward at {options.tilt:g} rad. Keep {1.5 * options.way:g} m free on all '
            'sides, then add --fly.'
        )
        return 0
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    link = MamboLink(
        'ble' if options.bluetooth else 'wifi', options.address, options.port, options.tilt
    )
    try:
        link.connect()
        problem = _measure(link, options, ended)
    except MamboLinkError as error:
        problem = str(error)
    finally:
        link.close()
    if problem:
        print(f'error: {problem}', file=sys.stderr)
    return 1 if problem else 0


if __name__ == '__main__':
    sys.exit(main())
