"""Drivers: from camera image to detections, and from waypoint to motion, for one robot each."""
