"""Headless Chromium for tests of pages, which are skipped without one."""

import base64
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from playwright.sync_api import sync_playwright
from waiting import PATIENCE, wait_until

_WORKSPACE = Path(os.environ.get('MAASI_WORKSPACE', Path(__file__).parents[1] / '.workspace'))
_FETCHED = Path(os.environ.get('PLAYWRIGHT_BROWSERS_PATH', _WORKSPACE / 'browsers'))


def _chromium():
    """Return the Chromium of the system, or one that scripts/test has fetched and that starts."""
    for name in ('chromium', 'chromium-browser'):
        if found := shutil.which(name):
            return found
    for file in sorted(_FETCHED.glob('chromium-*/chrome-linux*/chrome')):
        # Libraries may be missing.
        if subprocess.run([file, '--version'], capture_output=True, check=False).returncode == 0:
            return str(file)
    return None


CHROMIUM = _chromium()

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason='no Chromium on this machine (sudo apt install chromium)'
)


class Page:
    """A page with its errors and requests."""

    def __init__(self, page):
        self.page = page
        self.errors = []
        self.requests = []
        page.set_default_timeout(1000.0 * PATIENCE)
        page.on('console', self._add_message)
        page.on('pageerror', lambda error: self.errors.append(str(error)))
        page.on('request', lambda request: self.requests.append(request.url))

    def _add_message(self, message):
        if message.type in ('error', 'warning'):
            self.errors.append(message.text)

    def open(self, address):
        self.page.goto(address)
        self.page.wait_for_selector('body[data-ready]')

    def show(self, scene, *events):
        """Open the replay of a scene and its events."""
        # Needs the built workspace, which scripts/test may not have yet.
        from maasi_sim.run.view.event_log import EventLog
        from maasi_sim.run.view.page_file import write_replay

        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / 'page.html'
            write_replay(EventLog(scene, list(events)), file)
            self.open(file.as_uri())

    def place(self, *position):
        """Return where a position [m] is on the map [px]."""
        return self.page.evaluate(f'maasi.camera.project({list(map(float, position))})')[:2]

    def pixels(self, canvas='#map'):
        """Return the pixels of a canvas: red, green, blue and opacity."""
        address = self.page.evaluate(f'document.querySelector("{canvas}").toDataURL()')
        data = np.frombuffer(base64.b64decode(address.partition(',')[2]), np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)[:, :, [2, 1, 0, 3]].astype(int)

    def colour(self, x, y, canvas='#map'):
        return self.pixels(canvas)[round(y), round(x)][:3].tolist()

    def near(self, colour, tolerance=40):
        """Return which pixels of the map nearly have a colour."""
        return np.abs(self.pixels()[:, :, :3] - colour).max(axis=2) < tolerance

    def tip(self, *position):
        """Return what is written at a position [m] of the map."""
        self.settle()
        (x, y), box = self.place(*position), self.page.locator('#map').bounding_box()
        self.page.mouse.move(box['x'] + x, box['y'] + y)
        return self.page.inner_text('#tip') if self.page.is_visible('#tip') else ''

    def number(self):
        return int(self.page.inner_text('#found_count').split()[0])

    def seek(self, seconds):
        self.page.evaluate(f'maasi.seek({seconds})')
        self.settle()

    def until(self, condition, limit=PATIENCE):
        """Wait until an expression is true; the page forbids evaluation inside of it."""
        evaluate, rest = self.page.evaluate, self.page.wait_for_timeout
        wait_until(lambda: evaluate(condition), lambda: rest(50), condition, limit)

    def settle(self):
        """Wait until the page has drawn its state."""
        self.page.evaluate(
            'new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))'
        )


@contextlib.contextmanager
def browser():
    """Yield a browser for successive pages."""
    with sync_playwright() as player:
        # Root, as in containers, has no sandbox.
        arguments = ['--no-sandbox'] if os.geteuid() == 0 else []
        made = player.chromium.launch(executable_path=CHROMIUM, args=arguments)
        try:
            yield made
        finally:
            made.close()


@contextlib.contextmanager
def page_of(browser, width=1280, height=720, reduced_motion='reduce', **options):
    """Yield a page, which must report no errors and contact no other host; no autoplay."""
    viewport = {'width': width, 'height': height}
    page = browser.new_page(viewport=viewport, reduced_motion=reduced_motion, **options)
    try:
        shown = Page(page)
        yield shown
        assert shown.errors == []
        hosts = [urlsplit(address).hostname for address in shown.requests]
        assert {*hosts, None} == {*hosts[:1], None}
    finally:
        page.close()


@contextlib.contextmanager
def chromium(*size, **options):
    """Yield a page in its own browser."""
    with browser() as own, page_of(own, *size, **options) as shown:
        yield shown


if __name__ == '__main__':
    # For scripts/test.
    sys.exit(CHROMIUM is None)
