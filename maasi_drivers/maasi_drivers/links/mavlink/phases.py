"""Phases of a vehicle's flight from its first heartbeat to the end."""

from enum import Enum


class VehiclePhase(Enum):
    """Phase of a vehicle; the value is the reason why it does not continue."""

    CONNECTING = 'no heartbeat yet'
    PREPARING = 'no position estimate yet'
    WAITING = 'not armed'
    STARTING = 'changing mode'
    ARMING = 'arming'
    RISING = 'climbing'
    FLYING = ''
    RELEASED = 'the pilot has taken over'
    ENDING = 'ends'
    STOPPED = 'disarmed'
    REFUSED = 'released'


#: Phases in which the driver commands the vehicle.
COMMANDED = (
    VehiclePhase.STARTING,
    VehiclePhase.ARMING,
    VehiclePhase.RISING,
    VehiclePhase.FLYING,
    VehiclePhase.ENDING,
)
#: Phases in which the service `arm` is refused with the fault.
UNABLE = (
    VehiclePhase.CONNECTING,
    VehiclePhase.RELEASED,
    VehiclePhase.ENDING,
    VehiclePhase.REFUSED,
)
