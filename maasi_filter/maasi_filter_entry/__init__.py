"""Console scripts, imported before NumPy and rclpy so that SIGINT leaves no traceback."""

import signal
import sys
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

# What the commands import at once, and only extras require.
_OF_EXTRAS = ('distributed', 'matplotlib', 'setproctitle')


def run(target: str, ros: bool = True) -> Any:
    """Import a function or the class of a node, `module:name`, run it; return the exit code."""
    # Nothing has been created yet, so there is nothing to clean up. A node, and whatever has
    # to clean up, sets its own handler in `main`.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        # To import rclpy would end the process.
        if ros and resolve_name('maasi_filter.ros.middleware:is_missing')():
            return 2
        found = resolve_name(target)
        if isinstance(found, type):
            found = partial(resolve_name('maasi_filter.ros.run_node:run'), found)
        return found()
    except ModuleNotFoundError as error:
        missing = error.name or ''
        package = missing.partition('.')[0]
        if package.startswith(('ament_', 'rcl')) or package.endswith(
            ('_interfaces', '_msgs', '_srvs')
        ):
            needed = 'it needs ROS 2 (Jazzy or Kilted) and maasi_msgs, built and sourced'
        elif package in _OF_EXTRAS:
            needed = 'it comes with an extra of the package'
        else:
            raise
        name = Path(sys.argv[0]).name
        print(f'error: {name}: no module {missing}: {needed} (docs/install.md)', file=sys.stderr)
        return 2


filter_node = partial(run, 'maasi_filter.filter_node:FilterNode')
