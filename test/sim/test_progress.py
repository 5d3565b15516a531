"""Progress on the terminal, and where there is none."""

import io

from maasi_sim.run.progress import ProgressDisplay, Status


def status(found=0, time=1.0):
    return Status(time, measurements=7, found=found, targets=12, explored=0.25, factor=4.0)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_status_says_what_matters():
    text = status(found=3).text()
    for part in ('1.0 s', '7 measurements', '3 found of 12', '25 % explored', '4.0 x real time'):
        assert part in text
    assert 'of' not in Status(1.0, 7, 0, 0, 0.0, 1.0).text()


def test_plain_lines_come_now_and_then_and_when_something_is_new():
    for period, said in ((1e6, ['0 found', '1 found']), (0.0, ['0 found', '0 found', '1 found'])):
        stream = io.StringIO()
        display = ProgressDisplay(stream, period=period)
        for time, found in enumerate((0, 0, 1)):
            display.show(status(found, float(time)))
        display.close()
        lines = stream.getvalue().splitlines()
        assert [line[line.index('found') - 2 :][:7] for line in lines] == said


def test_a_terminal_gets_a_line_that_changes_and_lines_that_stay():
    stream = Terminal()
    display = ProgressDisplay(stream)
    display.say('begin [with brackets]')
    display.show(status())
    display.say('a warning')
    display.close()
    display.close()
    text = stream.getvalue()
    assert 'begin [with brackets]' in text
    assert '7 measurements' in text
    assert 'a warning' in text


def test_the_share_of_what_is_done_comes_now_and_then():
    for period, said in ((0.0, ['replay: 0 %', 'replay: 50 %']), (1e6, ['replay: 0 %'])):
        stream = io.StringIO()
        display = ProgressDisplay(stream, period=period)
        display.share('replay', 0.0)
        display.share('replay', 0.5)
        assert stream.getvalue().splitlines() == said
