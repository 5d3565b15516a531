"""The page of a search in one process, during the search and afterwards."""

from maasi_sim.run.log import RunLog
from maasi_sim.run.view.event_log import Event, EventLog
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.live_view import LiveView
from maasi_sim.run.view.scene import scene_of


def event_log(log: RunLog, name: str = 'search') -> EventLog:
    """Return the page events of a search."""
    events: list[Event] = []
    maker = EventMaker(scene_of(name, log.scenario, log.seed), events.append)
    for fact in log.facts:
        maker.add(fact)
    maker.end(log.end_reason)
    return EventLog(maker.scene, events)


class SearchPage:
    """Serves the page of a running search."""

    def __init__(self, log: RunLog) -> None:
        self._log = log
        self._live = LiveView(scene_of('search', log.scenario, log.seed))
        self._live.announce(print)
        for fact in log.facts:
            self._live.put(EventMaker.add, fact)
        log.listeners.append(lambda fact: self._live.put(EventMaker.add, fact))

    def end(self) -> None:
        """Show how the search ended and stop serving."""
        reason = self._log.end_reason
        self._live.put(EventMaker.end, reason)
        self._live.finish(f'ended: {reason}')
        self._live.close()
