"""Messages as facts: whatever they hold, a run goes on, its report is written, and it says so."""

import json

import pytest
from rclpy.serialization import serialize_message
from test_message_corpus import Corpus, kind_of

from maasi_msgs.msg import LockstepStep
from maasi_sim.run.bag import load_types
from maasi_sim.run.log import RunEnd
from maasi_sim.run.missions import load_mission
from maasi_sim.run.report_files import write_report
from maasi_sim.run.view.event_log import line
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.recording import facts_for
from maasi_sim.run.view.scene import scene_of


@pytest.mark.parametrize('name', ['field', 'buildings_four'])
@pytest.mark.parametrize('seed', range(2))
def test_bad_messages_are_dropped_by_name_and_the_report_is_written(tmp_path, name, seed):
    mission, corpus, types = load_mission(name), Corpus(seed), load_types()
    observer, events = mission.observer(types), []
    maker = EventMaker(scene_of(name, mission.scenario), lambda item: events.append(line(item)))
    facts = facts_for(maker.scene, waits=True)
    kinds = {
        topic: kind
        for topic in observer.topics
        for kind in (observer.kind(topic),)
        if kind != 'maasi_msgs/msg/LockstepStep'
    }
    step = serialize_message(LockstepStep(robots=mission.scenario.names()))
    observer.add('/lockstep/step', step)
    list(facts.of('/lockstep/step', 'maasi_msgs/msg/LockstepStep', LockstepStep()))
    for _ in range(1000):
        topic = corpus.pick(sorted(kinds))
        message = corpus.message(kind_of(kinds[topic])(), 'map', (0, 0))
        try:
            data = serialize_message(message)
        except SystemError:
            continue  # what rclpy cannot send
        observer.add(topic, data)
        observer.settle()
        for fact in facts.of(topic, kinds[topic], message):
            maker.add(fact)
    assert len(events) > 300
    assert len(observer.complaints) == len({text.split(': ')[0] for text in observer.complaints})
    if name == 'field':
        assert any(text.startswith('/found_targets: ') for text in observer.complaints)
    report = write_report(mission, observer.record(RunEnd('time_limit', 10.0, 1.0)), tmp_path)
    assert json.loads((tmp_path / 'report.json').read_text()) == report
