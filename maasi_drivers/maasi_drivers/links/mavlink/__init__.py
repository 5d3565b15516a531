"""Vehicles that use MAVLink: ArduCopter, ArduSub and PX4. Without ROS."""

import os

# pymavlink reads this on import and uses MAVLink 1 without it.
os.environ['MAVLINK20'] = '1'
