"""The link to a Parrot Mambo: pyparrot, its pilot and its dead reckoning. Without ROS."""
