"""Pymavlink, as MAVLink 2: imported from here, so that it is asked for before the import."""

from pymavlink import mavutil

mavlink = mavutil.mavlink

__all__ = ['mavlink', 'mavutil']
