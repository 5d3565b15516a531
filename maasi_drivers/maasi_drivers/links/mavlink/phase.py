"""The phases of a driver's work with a vehicle."""

from __future__ import annotations

from enum import Enum


class Phase(Enum):
    """How far the driver is with a vehicle; the value says why it does not continue from there."""

    CONNECTING = 'nothing heard yet'
    PREPARING = 'no position estimate yet'
    WAITING = 'not armed'
    STARTING = 'takes the mode'
    ARMING = 'is being armed'
    RISING = 'is on its way to its height'
    FLYING = ''
    RELEASED = 'the pilot has taken over'
    ENDING = 'ends'
    STOPPED = 'is disarmed'
    REFUSED = 'is left alone'


#: Phases in which the driver commands the vehicle.
COMMANDED = (Phase.STARTING, Phase.ARMING, Phase.RISING, Phase.FLYING, Phase.ENDING)
