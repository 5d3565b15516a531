"""Quality of service, by what a topic is for."""

from __future__ import annotations

from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from maasi_filter.ros.node_settings import LIVELINESS_LEASE

# What nobody may miss: batches, detections, updates, states, decisions, lockstep.
RELIABLE = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, depth=1, reliability=ReliabilityPolicy.RELIABLE
)

# What one who comes later needs as well: found targets, the truth, the last update.
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# Updates of the filter: reliable, and a planner that is started again hears of the last ones.
UPDATES = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# As LATCHED, for a reader of several writers.
LATCHED_ALL = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# States of robots. Liveliness is asserted by the executor thread: a process whose executor hangs
# loses it, though its middleware goes on.
LIVELY = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
    liveliness_lease_duration=Duration(seconds=LIVELINESS_LEASE),
)
# How often it is asserted [s].
LIVELINESS_PERIOD = 0.1

# Commands to a robot: an old one is worth nothing on a link that was down.
COMMANDS = QoSProfile(depth=3, reliability=ReliabilityPolicy.RELIABLE)

# Transforms, as tf2 reads and writes them.
TRANSFORMS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE
)

# What sensors publish: each message replaces the one before.
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
SENSOR_READER = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def liveliness_reader(lease: float) -> QoSProfile:
    """Return how a guard reads states: for the loss of liveliness after `lease` seconds."""
    return QoSProfile(
        depth=1,
        # Liveliness without data comes with heartbeats, which only reliable readers get.
        reliability=ReliabilityPolicy.RELIABLE,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=Duration(seconds=lease),
    )


def sensor_reader(lockstep: bool) -> QoSProfile:
    """Return how sensor data is read: best effort, or in lockstep all of it."""
    return RELIABLE if lockstep else SENSOR_READER


def sensor_writer(lockstep: bool) -> QoSProfile:
    """Return how sensor data is written."""
    return RELIABLE if lockstep else SENSOR
