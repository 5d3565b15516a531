"""Progress on the terminal, and where there is none."""

import io

from maasi_sim.run.progress import ProgressDisplay


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


def test_the_share_of_what_is_done_comes_now_and_then():
    for period, said in ((0.0, ['replay: 0 %', 'replay: 50 %']), (1e6, ['replay: 0 %'])):
        stream = io.StringIO()
        display = ProgressDisplay(stream, period=period)
        for share in (0.0, 0.5):
            display.share('replay', share)
        assert stream.getvalue().splitlines() == said
