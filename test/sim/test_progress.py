"""Progress on the terminal, and where there is none."""

import io
import os
import subprocess
import sys

from numba import njit
from small_field import SMALL_FIELD

from maasi_planner.planners import make_planner
from maasi_sim import compiling
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.search import search


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_plain_lines_come_now_and_then_and_when_something_is_new():
    for period, said in ((1e6, ['0 found', '1 found']), (0.0, ['0 found', '0 found', '1 found'])):
        stream = io.StringIO()
        display = ProgressDisplay(stream, period=period)
        for time, found in enumerate((0, 0, 1)):
            display.show(f'{time} s  {found} found', found)
        display.close()
        assert [line.partition('  ')[2] for line in stream.getvalue().splitlines()] == said


def test_a_terminal_gets_a_line_that_changes_and_lines_that_stay(monkeypatch):
    monkeypatch.setenv('COLUMNS', '16')
    stream = Terminal()
    display = ProgressDisplay(stream)
    display.say('begin')
    display.show('7 measurements in a long line', 0)
    display.say('a warning')
    display.close()
    display.close()
    erase, line = '\r\x1b[K', '7 measurements '
    assert stream.getvalue() == f'begin\n{erase}{line}{erase}a warning\n{line}\n'
    display._line = 'half'
    display.say('done', instead=True)
    assert stream.getvalue().endswith(f'{erase}done\n')


def test_how_far_something_is_comes_now_and_then_and_on_a_terminal_only_if_quiet():
    for period, said in ((0.0, ['replay: 1 %', 'replay: 50 %']), (1e6, ['replay: 1 %'])):
        stream = io.StringIO()
        display = ProgressDisplay(stream, period=period)
        for share in (0.0, 0.01, 0.5):
            display.update('starting', quiet=True)
            display.share('replay', share)
        assert stream.getvalue().splitlines() == said
    stream = Terminal()
    ProgressDisplay(stream).update('starting', quiet=True)
    assert 'starting' in stream.getvalue()


def test_compiling_is_said_and_loading_from_the_cache_is_not(tmp_path):
    (tmp_path / 'kernel.py').write_text(
        'from numba import njit\n@njit(cache=True)\ndef double(number): return 2 * number\n'
    )
    words = 'import kernel; from maasi_sim import compiling; compiling.PATIENCE = 0.0\n'
    words += 'with compiling.compiling_said(): print(kernel.double(2))'
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}
    said = []
    for _ in range(2):
        command = [sys.executable, '-c', words]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout == '4\n'
        said.append(done.stderr.splitlines())
    assert said == [['compiling kernels (once on a machine, takes a minute or two): 0 done'], []]


def test_a_search_says_that_it_compiles(monkeypatch, capsys):
    monkeypatch.setattr(compiling, 'PATIENCE', 0.0)

    def planner(settings, missing):
        njit(lambda number: 2 * number)(2)
        return make_planner(settings.name, settings)

    search(scenario_from_values(SMALL_FIELD, 'field'), 1, 1, planner)
    assert capsys.readouterr().err.startswith('compiling kernels')
