"""Geometry of the search: areas, keep-out zones, obstacles, maps and coordinates."""
