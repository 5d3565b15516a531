"""A command that measures a Mambo's speed at its largest tilt: `mambo.full_speed`.

Each leg applies the largest tilt in one direction and then the other for the same time T, from
rest: without drag it is g tan(tilt) T^2 long, an upper bound for any drone. Then the drone hovers
and flies back.
"""

import argparse
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from maasi_drivers.links.mambo.link import MamboLink, MamboLinkError, PositionEvent
from maasi_drivers.links.mambo.reckoning import Course, TiltModel
from maasi_drivers.settings.vehicles import LEAST_TILT, MOST_TILT
from maasi_filter.arrays import FloatArray

_REST, _STOPPING = 3.0, 1.8  # rest before each leg; the firmware stops the drone first [s]
_EXCESS = 1.5  # above this multiple of the planned distance it did not follow the command
# Longest silence, and longest waits for take-off and connection [s].
_SILENCE, _PATIENCE = 1.5, 15.0
_LEAST_BATTERY = 0.2
# Largest residual of a fit [m], and relative uncertainty of the speed [1].
_MOST_MISFIT, _MOST_UNCERTAIN = 0.05, 0.35
_LEAST, _MOST = (0.05, 0.0), (20.0, 0.9)  # search range of drag [1/s] and delay [s]


class MeasurementError(RuntimeError):
    """The measurement failed; the text contains the cause."""


@dataclass(frozen=True)
class MeasuredSpeed:
    """Result of a measuring flight."""

    full_speed: float  # steady speed at the largest tilt [m/s]
    delay: float  # from a command until the position shows its effect [s]
    uncertainty: float  # relative standard deviation of `full_speed` [1]


@dataclass
class Leg:
    """A leg from rest: tilts (share of the largest) and positions forward [m] by time."""

    begin: float  # monotonic clock [s]
    origin: float  # position of rest, forward of the take-off point [m]
    tilts: list[tuple[float, float]] = field(default_factory=list)
    events: list[tuple[float, float]] = field(default_factory=list)


class MeasuringFlight:
    """Flies the legs, each at most `length` [m] long."""

    def __init__(
        self, link: MamboLink, length: float, legs: int, clock: Callable[[], float]
    ) -> None:
        self.link, self.length = link, length
        self.number = legs
        self.clock = clock
        self.legs: list[Leg] = []
        #: Duration of one tilt [s].
        self.time = math.sqrt(length / (9.81 * math.tan(link.tilt)))
        self._event: PositionEvent | None = None

    def steps(self) -> Iterator[str]:
        """Take off and fly; yields its current action in each control period. The caller lands."""
        link = self.link
        yield from self._await('connecting', lambda: link.connected)
        yield from self._await(
            'waiting for the state of the drone',
            lambda: (
                link.flying_state == 'landed' and link.battery >= 0.0 and link.position is not None
            ),
        )
        self._check_battery()
        link.take_off()
        yield from self._await('taking off', lambda: link.flying_state in ('hovering', 'flying'))
        for number in range(self.number):
            yield from self._fly_leg(1.0 if number % 2 == 0 else -1.0)

    def _check_battery(self) -> None:
        if self.link.battery < _LEAST_BATTERY:
            raise MeasurementError(
                f'battery: read {self.link.battery:.2f}, allowed is {_LEAST_BATTERY} or more'
            )

    def _await(self, what: str, condition: Callable[[], bool]) -> Iterator[str]:
        end = self.clock() + _PATIENCE
        while not condition():
            if self.clock() > end:
                raise MeasurementError(
                    f'{what}: {self.link.error or self.link.flying_state or "nothing received"} '
                    f'after {_PATIENCE:g} s'
                )
            self.link.keep_alive()
            yield what

    def _fly_leg(self, sign: float) -> Iterator[str]:
        begin = self.clock()
        rests: list[float] = []
        while (passed := self.clock() - begin) < _REST or not rests:
            event = self._look()
            if event is not None and passed > _STOPPING:
                rests.append(float(event.position[0]))
            self.link.steer(0.0, 0.0, 0.0, 0.0)
            yield 'hovering'
        leg = Leg(self.clock(), float(np.mean(rests)))
        while (passed := self.clock() - leg.begin) < 2.0 * self.time:
            share = sign if passed < self.time else -sign
            if not leg.tilts or leg.tilts[-1][1] != share:
                leg.tilts.append((passed, share))
            event = self._look()
            if event is not None:
                leg.events.append((event.received - leg.begin, float(event.position[0])))
            self.link.steer(share, 0.0, 0.0, 0.0)
            yield f'leg {len(self.legs) + 1} of {self.number}'
        self.legs.append(leg)
        self.link.steer(0.0, 0.0, 0.0, 0.0)

    def _look(self) -> PositionEvent | None:
        link, now = self.link, self.clock()
        link.keep_alive()
        event = link.position
        if event is None or now - event.received > _SILENCE or now - link.received_at > _SILENCE:
            raise MeasurementError(f'link: no position for {_SILENCE} s')
        if link.error:
            raise MeasurementError(link.error)
        self._check_battery()
        if link.flying_state not in ('hovering', 'flying'):
            raise MeasurementError(f'the drone is {link.flying_state}, allowed is that it flies')
        if event is self._event:
            return None
        self._event = event
        far = float(np.hypot(*event.position[:2]))
        if far > _EXCESS * self.length:
            raise MeasurementError(
                f'position: read {far:.2f} m from the take-off point, allowed are '
                f'{_EXCESS * self.length:.2f} m'
            )
        return event


def fit_speed(legs: list[Leg], tilt: float) -> MeasuredSpeed:
    """Return the speed and delay that fit the legs best, for a tilt [rad]."""
    from scipy.optimize import least_squares

    if sum(len(leg.events) for leg in legs) < 6:
        raise MeasurementError('position events: read fewer than 6, allowed are 6 or more')

    def left(parameters: FloatArray) -> FloatArray:
        drag, delay = parameters.tolist()
        model = TiltModel(tilt, 9.81 * math.tan(tilt) / drag, 1.0, 1.0)
        return np.array(
            [
                position - leg.origin - _travelled(model, leg.tilts, passed - delay)
                for leg in legs
                for passed, position in leg.events
            ]
        )

    fit = min(
        (
            least_squares(left, [drag, 0.2], bounds=(_LEAST, _MOST), x_scale=(drag, 0.1))
            for drag in (0.3, 3.0)
        ),
        key=lambda fit: float(fit.cost),
    )
    drag, delay = fit.x.tolist()
    misfit = math.sqrt(2.0 * fit.cost / len(fit.fun))
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * 2.0 * fit.cost / max(len(fit.fun) - 2, 1)
    uncertainty = math.sqrt(covariance[0, 0]) / drag
    if misfit > _MOST_MISFIT:
        raise MeasurementError(
            f'misfit: read {misfit:.3f} m, allowed is {_MOST_MISFIT} m: the flight does not match '
            'tilt commands (wind? floor without texture?)'
        )
    if uncertainty > _MOST_UNCERTAIN or not _LEAST[0] * 1.01 < drag < _MOST[0] / 1.01:
        raise MeasurementError(
            f'speed: uncertain by {100.0 * uncertainty:.0f} %, '
            f'allowed are {100.0 * _MOST_UNCERTAIN:.0f} %: fly more or longer legs'
        )
    return MeasuredSpeed(9.81 * math.tan(tilt) / drag, delay, uncertainty)


def _travelled(model: TiltModel, tilts: list[tuple[float, float]], passed: float) -> float:
    commands = [(begin, np.array([share, 0.0, 0.0, 0.0])) for begin, share in tilts]
    course = Course(np.zeros(3), np.zeros(3), 0.0)
    return float(model.follow(course, commands, -math.inf, passed).position[0])


# Lowest and highest value by option.
_ALLOWED = {
    'tilt': (LEAST_TILT, MOST_TILT),
    'way': (0.5, 10.0),
    'legs': (2, 50),
    'port': (1024, 65535),
}
_PERIOD = 0.05
_LANDING = 15.0  # longest wait for landing [s]


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='measure_mambo',
        description='Let a Mambo take off, tilt forward and backward repeatedly, and land; print '
        'mambo.full_speed and mambo.delay for its driver. Ctrl-C lands it.',
    )

    def add(name: str, help: str, **options: Any) -> None:
        parser.add_argument(f'--{name}', help=help, **options)

    add('fly', 'take off and fly (default: only print the plan)', action='store_true')
    add('address', 'address of the drone (default: %(default)s)', default='192.168.99.3')
    add('bluetooth', 'use Bluetooth instead of WiFi', action='store_true')
    add('port', 'UDP port for its messages (default: %(default)s)', type=int, default=43210)
    tilt = 'largest tilt, motion.tilt of its driver [rad] (default: %(default)s)'
    add('tilt', tilt, type=float, default=0.1, metavar='RAD')
    length = (
        'longest distance forward and backward of its position; keep half of it more free '
        '[m] (default: %(default)s)'
    )
    add('way', length, type=float, default=1.0, metavar='M')
    add('legs', 'number of legs (default: %(default)s)', type=int, default=6, metavar='N')
    return parser


def _measure(link: MamboLink, options: argparse.Namespace, ended: threading.Event) -> None:
    flight = MeasuringFlight(link, options.way, options.legs, time.monotonic)
    said = ''
    try:
        for what in flight.steps():
            if what != said:
                said = what
                print(what, flush=True)
            if ended.wait(_PERIOD):
                raise MeasurementError('interrupted')
    finally:
        end = time.monotonic() + _LANDING
        while link.connected and link.flying_state != 'landed' and time.monotonic() < end:
            link.keep_alive()
            link.land()
            time.sleep(_PERIOD)
        if link.airborne:
            print('error: the drone did not report that it landed', file=sys.stderr)
    found = fit_speed(flight.legs, link.tilt)
    print(
        f'\nmotion.tilt: {link.tilt:g}\n'
        f'mambo.full_speed: {found.full_speed:.3g}    # m/s, +- {100 * found.uncertainty:.1f} %\n'
        f'mambo.delay: {found.delay:.2f}    # s'
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the measurement and return its exit code."""
    options = build_parser().parse_args(arguments)
    for name, (low, high) in _ALLOWED.items():
        value = getattr(options, name)
        if not low <= value <= high:
            allowed = f'{low:.4g} to {high:.4g}'
            print(f'error: --{name}: read {value:g}, allowed is {allowed}', file=sys.stderr)
            return 2
    if not options.fly:
        print(
            f'With --fly it takes off and flies {options.legs} legs of at most {options.way:g} m '
            f'forward and backward at {options.tilt:g} rad. Keep {1.5 * options.way:g} m free '
            'on all sides.'
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
        _measure(link, options, ended)
    except (MamboLinkError, MeasurementError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    finally:
        link.close()
    return 0


if __name__ == '__main__':
    sys.exit(main())
