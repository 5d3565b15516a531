"""Vehicles that speak MAVLink: ArduCopter, ArduSub and PX4. Without ROS."""

import os

# pymavlink reads it when it is imported, and speaks MAVLink 1 without it.
os.environ['MAVLINK20'] = '1'
