"""Opens a page in the user's browser, where there is one to be seen."""

from __future__ import annotations

import contextlib
import os
import sys
import webbrowser


def open_browser(address: str) -> bool:
    """Open an address in a browser; return whether there is one with a display."""
    if sys.platform.startswith('linux') and not (
        os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')
    ):
        return False
    with contextlib.suppress(webbrowser.Error, OSError):
        return webbrowser.open(address)
    return False
