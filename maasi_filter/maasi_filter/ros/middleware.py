"""Check that the middleware named in the environment is installed."""

import os
import sys

from ament_index_python import get_resources

_VARIABLE = 'RMW_IMPLEMENTATION'


def is_missing() -> bool:
    """Print an error and return True if it is missing, before rclpy ends the process."""
    name = os.environ.get(_VARIABLE)
    installed = sorted(get_resources('rmw_typesupport').keys() - {'rmw_implementation'})
    if not name or name in installed:
        return False
    allowed = ', '.join(installed)
    print(
        f"error: {_VARIABLE}: read '{name}', which is not installed; allowed is {allowed}",
        file=sys.stderr,
    )
    return True
