"""A sensor calibrated from recordings of one target. Without ROS."""
