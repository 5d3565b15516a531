"""Quality of service profiles by purpose."""

from collections.abc import Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from maasi_filter.ros.node_settings import LIVELINESS_LEASE


def _reliable(depth: int | None, latched: bool = False, **options: Any) -> QoSProfile:
    """Return a profile of the last `depth` messages or all; latched: for late joiners."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if depth is None else HistoryPolicy.KEEP_LAST,
        depth=depth or 1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        **options,
    )


# Lossless topics: batches, detections, updates, states, decisions, lockstep.
RELIABLE = _reliable(None)
LATCHED = _reliable(1, latched=True)  # found targets, the truth, the last update
LATCHED_ALL = _reliable(None, latched=True)  # as LATCHED, for a reader of several publishers
# Filter updates: a restarted planner receives the last ones.
UPDATES = _reliable(100, latched=True)
# States of robots. Liveliness is asserted by the executor thread: a process whose executor hangs
# loses it, although the threads of its middleware still run.
LIVELY = _reliable(
    None,
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
    liveliness_lease_duration=Duration(seconds=LIVELINESS_LEASE),
)
LIVELINESS_PERIOD = 0.1  # period of assertion [s]
# Commands to a robot: old ones are useless after a link failure.
COMMANDS = _reliable(3)
TRANSFORMS = _reliable(100)  # transforms, as in tf2
# Sensor data: each message replaces the previous one.
SENSOR = _reliable(10)
SENSOR_READER = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def liveliness_reader(lease: float) -> QoSProfile:
    """Return the profile of a guard for states: liveliness is lost after `lease` seconds."""
    # Without data, liveliness is asserted by heartbeats, which only reliable readers get.
    return _reliable(
        1,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=Duration(seconds=lease),
    )


def sensor_reader(lockstep: bool) -> QoSProfile:
    """Return the profile of readers of sensor data: best effort, or lossless in lockstep."""
    return RELIABLE if lockstep else SENSOR_READER


def reader_of(profiles: Sequence[QoSProfile]) -> QoSProfile:
    """Return the profile that receives all messages of publishers."""
    reliable = all(item.reliability == ReliabilityPolicy.RELIABLE for item in profiles)
    latched = all(item.durability == DurabilityPolicy.TRANSIENT_LOCAL for item in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if reliable else HistoryPolicy.KEEP_LAST,
        depth=1000,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
