"""Statements of persons in facts, log lines and reports."""

import pytest

from maasi_msgs.msg import LockstepStep, Report
from maasi_sim.run.bag import load_types
from maasi_sim.run.log import RunLog
from maasi_sim.run.message_facts import MessageFacts, is_read
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.scenario.loading import find_scenario, load_scenario

KIND = 'maasi_msgs/msg/Report'


def report_of(number, second, **fields):
    message = Report(id=number, source='Ann', weight=0.5)
    message.header.stamp.sec, message.header.frame_id = second, 'map'
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def zone(number, second=2, **fields):
    return report_of(number, second, kind=Report.SEARCHED, zone='10 20 30', **fields)


@pytest.fixture
def facts():
    made = MessageFacts(waits=True)
    list(made.of('/lockstep/step', 'maasi_msgs/msg/LockstepStep', LockstepStep()))
    return lambda message, topic='/reports': list(made.of(topic, KIND, message))


def test_a_report_is_one_fact_even_if_a_restarted_filter_repeats_it(facts):
    assert is_read('/reports', KIND) and KIND in load_types().types
    (fact,) = facts(zone(1))
    assert (fact.time, fact.team, fact.report.id, fact.report.source) == (2.0, '', 1, 'Ann')
    assert 'm² searched by Ann with a probability of detection of 0.5' in str(fact.report)
    assert facts(zone(1)) == []
    # Another filter of the team, and another report.
    assert [item.team for item in facts(zone(1), '/a/reports')] == ['a']
    assert len(facts(zone(2))) == 1
    # A new search begins.
    (fact,) = facts(report_of(0, 3, kind=Report.CLEARED))
    assert fact.report is None
    assert len(facts(zone(1))) == 1


@pytest.mark.parametrize(
    ('fields', 'text'),
    [
        ({'kind': 9}, 'kind: read 9, allowed are 0 to 4'),
        ({'zone': 'here'}, 'zone: allowed are well-known text'),
        ({'zone': ''}, 'zone: allowed are well-known text'),
        ({'weight': float('nan')}, 'weight, radius: read nan'),
        ({'weight': 2.0}, 'weight: read 2, allowed are numbers above 0, to 1'),
        ({'weight': 0.3, 'kind': Report.REJECTED}, 'weight: read 0.3, allowed are numbers from'),
        ({'kind': Report.SIGHTING}, 'radius: read 0, allowed are numbers above 0'),
    ],
)
def test_unusable_reports_are_dropped_by_name(facts, fields, text):
    message = zone(1)
    for name, value in fields.items():
        setattr(message, name, value)
    (fact,) = facts(message)
    assert fact.level == 'warning'
    assert text in fact.text


def test_reports_are_events_of_the_page_and_of_the_report(facts):
    events = []
    maker = EventMaker({'name': 'x', 'robots': {}, 'bounds': [[0, 100], [0, 100]]}, events.append)
    log = RunLog(load_scenario(find_scenario('mambo')), 1)
    # The zone of another kind is not read.
    sighting = report_of(2, 3, kind=Report.SIGHTING, radius=5.0, zone='here')
    sighting.position.x = 7.0
    review = report_of(3, 4, kind=Report.REJECTED, target=6, weight=0.9, source='')
    for message in (zone(1), sighting, review, report_of(0, 5, kind=Report.CLEARED)):
        for fact in facts(message):
            maker.add(fact)
            log.add(fact)
    reports = [event for event in events if event[1] == 'report']
    assert [event[3] for event in reports] == ['searched', 'sighting', 'rejected', 'cleared']
    assert reports[1][4:] == [0, [7.0, 0.0, 0.0], 5.0, 0.5, []]
    assert reports[2][4] == 6
    (ring,) = reports[0][8][0]['rings']
    assert len(ring) == 129
    assert [event[4:] for event in events if event[1] == 'log'][1:] == [
        ['Ann', 'sighting of Ann at (7, 0) m, radius 5 m, 0.5 expected targets'],
        ['a person', 'target 6 rejected with reliability 0.9'],
    ]
    assert [event['agent'] for event in log.events] == ['Ann', 'Ann', 'a person']
    assert log.events[2] == {
        'time': 4.0,
        'agent': 'a person',
        'event': 'target 6 rejected with reliability 0.9',
    }
