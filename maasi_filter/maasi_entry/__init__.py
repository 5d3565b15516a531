"""Console scripts: imports end without a traceback on SIGINT.

A package of its own, because importing a module of the others loads NumPy and rclpy first. The
entry point `maasi_entry:maasi_filter.filter_node` runs `main` of `maasi_filter.filter_node`.
"""

from __future__ import annotations

import importlib
import signal
import sys
from typing import Any

# What the commands import at once, and only extras require.
_OF_EXTRAS = ('distributed', 'matplotlib', 'rich', 'setproctitle')


class _Script:
    """Runs `main` of a module; each attribute is the script of a module inside it."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> _Script:
        return _Script(f'{self._module}.{name}')

    def __call__(self) -> Any:
        # Nothing has been created yet, so there is nothing to clean up. A node, and whatever has
        # to clean up, sets its own handler in `main`.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        try:
            return importlib.import_module(self._module).main()
        except ModuleNotFoundError as error:
            missing = error.name or ''
            if _is_of_ros(missing):
                needed = 'it needs ROS 2 Jazzy and maasi_msgs, built and sourced'
            elif missing.partition('.')[0] in _OF_EXTRAS:
                needed = 'it comes with an extra of the package'
            else:
                raise
            name = self._module.rpartition('.')[2]
            text = f'error: {name}: no module {missing}: {needed} (docs/install.md)'
            print(text, file=sys.stderr)
            return 2


def _is_of_ros(module: str) -> bool:
    package = module.partition('.')[0]
    return package.startswith(('ament_', 'rcl')) or package.endswith(
        ('_interfaces', '_msgs', '_srvs')
    )


def __getattr__(package: str) -> _Script:
    # Other attributes, which pytest asks for, start nothing.
    if not package.startswith('maasi_'):
        raise AttributeError(package)
    return _Script(package)
