"""Calibration of sensors from recordings of one target. Without ROS."""
