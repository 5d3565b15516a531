"""Settings of drivers: the node, the camera, and the links to vehicles."""
