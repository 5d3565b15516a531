"""Headless Chromium for tests of pages; skipped by name where there is none."""

import contextlib
import os
import shutil
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import sync_playwright
from waiting import PATIENCE, wait_until

CHROMIUM = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser'))), None)

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason='no Chromium on this machine (sudo apt install chromium)'
)


class Page:
    """A page, and what it complained of and asked for."""

    def __init__(self, page):
        self.page = page
        self.errors = []
        self.requests = []
        page.set_default_timeout(1000.0 * PATIENCE)
        page.on('console', self._hear)
        page.on('pageerror', lambda error: self.errors.append(str(error)))
        page.on('request', lambda request: self.requests.append(request.url))

    def _hear(self, message):
        if message.type in ('error', 'warning'):
            self.errors.append(message.text)

    def open(self, address):
        self.page.goto(address)
        self.page.wait_for_selector('body[data-ready]')

    def number(self):
        return int(self.page.inner_text('#found_count').split()[0])

    def seek(self, seconds):
        self.page.evaluate(f'maasi.seek({seconds})')
        self.settle()

    def until(self, condition, limit=PATIENCE):
        """Wait until an expression is true; the page lets nothing be evaluated inside it."""
        evaluate, rest = self.page.evaluate, self.page.wait_for_timeout
        wait_until(lambda: evaluate(condition), lambda: rest(50), condition, limit)

    def settle(self):
        """Wait until what was asked for is drawn."""
        self.page.evaluate(
            'new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))'
        )


@contextlib.contextmanager
def browser():
    """Yield a browser for several pages, one after the other."""
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
    """Yield a page that complains of nothing and asks no other host; no replay plays by itself."""
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
    """Yield a page in a browser of its own."""
    with browser() as own, page_of(own, *size, **options) as shown:
        yield shown
