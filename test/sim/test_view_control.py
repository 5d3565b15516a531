"""The commands of a page: none waits for another one; the command line of the view node."""

import threading
from contextlib import closing
from functools import partial

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger
from waiting import PATIENCE, wait_until

from maasi_sim.run.view import control_node
from maasi_sim.run.view.control_node import Control
from maasi_sim.run.view.server import Hub, ViewServer
from maasi_sim.run.view.view_node import main


def serve(context, name, services, called):
    node = rclpy.create_node(name, context=context)

    def answer(service, _, response):
        called.append(service)
        response.success, response.message = True, service
        return response

    for service in services:
        node.create_service(Trigger, service, partial(answer, service))
    return node


def test_a_stop_of_all_does_not_wait_for_other_commands(domain, context, monkeypatch):
    monkeypatch.setattr(control_node, '_PATIENCE', PATIENCE)
    called, answers = [], []
    stops = ['/mambo/stop', '/rover/stop']
    drivers = serve(context, 'drivers', [*stops, '/mambo/release', '/rover/release'], called)
    # Its services are there; it answers when it is spun.
    stuck = serve(context, 'stuck', ['/ghost/search/pause'], called)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(drivers)
    spinner = threading.Thread(target=executor.spin)
    spinner.start()
    control = Control(domain.number)
    others = [
        threading.Thread(target=lambda: answers.append(control('pause', 'ghost'))) for _ in range(3)
    ]
    try:
        for other in others:
            other.start()
        assert control('stop', None) == (True, '; '.join(stops))
        assert sorted(called) == stops and answers == []
        executor.add_node(stuck)
        for other in others:
            other.join()
        assert answers == [(True, '/ghost/search/pause')] * 3
    finally:
        control.close()
        executor.shutdown()
        spinner.join()
    assert control('stop', None) == (False, 'the run has ended')


def test_a_stop_of_all_passes_what_waits_in_the_browser(chromium):
    calls, released = [], threading.Event()

    def commander(command, robot):
        calls.append(command)
        if command != 'stop':
            released.wait()
        return True, command

    hub = Hub({'name': 'test', 'robots': {}, 'bounds': [[0, 1], [0, 1]], 'control': True})
    server = ViewServer(hub, 0, commander=commander)
    hub.put([0.0, 'log', '', 'team', '', 'begin'])
    try:
        with chromium() as shown:
            shown.open(server.address)
            # One connection is the stream of events; a browser opens six.
            for _ in range(10):
                shown.page.click('button[data-command=pause]')
            wait_until(lambda: len(calls) == 5, lambda: shown.page.wait_for_timeout(20))
            shown.page.click('button[data-command=stop]')
            wait_until(lambda: 'stop' in calls, lambda: shown.page.wait_for_timeout(20))
            answer = "document.querySelector('#controls [role=status]').innerText"
            shown.until(f"{answer} == 'stop all: stop'")
    finally:
        released.set()
        server.close()


def test_buttons_that_change_nothing_are_off_and_states_and_answers_are_whole(chromium):
    answer = 'pause: rover; ' + 'a long story, ' * 20 + 'whose end is read'
    hub = Hub({'name': 'test', 'robots': {}, 'bounds': [[0, 1], [0, 1]], 'control': True})
    made = ViewServer(hub, 0, commander=lambda command, robot: (True, answer))
    stopped = 'stopped by the service stop, until the service release is called'
    words = ('start', 'pause', 'resume', 'home', 'stop', 'release')
    steps = [
        ('Waiting for start', 0, '', 'waiting for start', {'start', 'home', 'stop'}),
        ('Searching', 1, '', 'moving', {'pause', 'home', 'stop'}),
        ('Paused', 3, '', 'paused', {'resume', 'home', 'stop'}),
        ('Sent home', 1, '', 'sent home, moving', {'pause', 'resume', 'stop'}),
        ('Stopped', 5, stopped, 'until released', {'start', 'home', 'stop', 'release'}),
        ('Stopped', 0, '', 'search stopped', {'start', 'home', 'stop'}),
    ]
    with closing(made) as server, chromium() as shown:
        hub.put([0.0, 'start', '', 5, 7])
        shown.open(server.address)
        shown.until("document.querySelector('#headline').textContent.startsWith('Starting: 5')")
        for time, (headline, status, reason, state, useful) in enumerate(steps):
            hub.put([float(time), 'mode', '/planner_node', headline.lower()])
            hub.put([float(time), 'robot', 'rover', [0.5, 0.5, 0.0, 0.0], 1.0, status, reason])
            text = "document.querySelector('#robots td.text')?.textContent.includes('{}')"
            shown.until(text.format(state))
            on = {word for word in words if shown.page.is_enabled(f'button[data-command={word}]')}
            assert on == useful, headline
            shown.until(f"document.querySelector('#headline').textContent.startsWith('{headline}')")
        shown.page.click('button[data-command=stop]')
        status = shown.page.locator('#controls [role=status]')
        shown.until("document.querySelector('#controls [role=status]').innerText.endsWith('read')")
        assert status.inner_text() == f'stop all: {answer}'
        # Nothing of it is cut.
        assert status.evaluate('(part) => part.scrollWidth <= part.clientWidth + 1')


def test_wrong_addresses_and_scenarios_are_refused(ros, capsys):
    rclpy.shutdown()
    assert main(['--host', '192.0.2.1']) == 2
    assert '192.0.2.1: Cannot assign' in capsys.readouterr().err
    assert main(['--scenario', 'no_such_scenario']) == 2
    assert 'no_such_scenario' in capsys.readouterr().err
