"""Console scripts: imports end without a traceback on SIGINT.

A package of its own, because importing a module of the others loads NumPy and rclpy first. The
entry point `maasi_entry:maasi_filter.filter_node` runs `main` of `maasi_filter.filter_node`.
"""

from __future__ import annotations

import importlib
import signal
from functools import partial
from typing import Any


class _Scripts:
    """Each attribute is the function that runs the module of that name."""

    def __init__(self, package: str) -> None:
        self._package = package

    def __getattr__(self, module: str) -> Any:
        return partial(_run, f'{self._package}.{module}')


def _run(module: str) -> Any:
    # Nothing has been created yet, so there is nothing to clean up. A node, and whatever has to
    # clean up, sets its own handler in `main`.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return importlib.import_module(module).main()


def __getattr__(package: str) -> _Scripts:
    if package.startswith('_'):
        raise AttributeError(package)
    return _Scripts(package)
