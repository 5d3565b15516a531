"""Marker arrays without stale markers."""

from __future__ import annotations

from visualization_msgs.msg import Marker, MarkerArray


class MarkerBoard:
    """
    Makes each array of markers replace the previous one.

    The first array deletes all markers that a viewer still shows of an earlier process; later
    arrays delete those that are no longer present. Other nodes on the same topic also lose their
    markers with the first array, until they publish again.

    """

    def __init__(self) -> None:
        self._shown: dict[tuple[str, int], Marker] | None = None

    def replace(self, markers: MarkerArray) -> MarkerArray:
        """Return an array that shows these markers and no others of this node."""
        now = {(item.ns, item.id): item for item in markers.markers if item.action == Marker.ADD}
        if self._shown is None:
            header = markers.markers[0].header if markers.markers else Marker().header
            gone = [Marker(header=header, action=Marker.DELETEALL)]
        else:
            gone = [
                Marker(header=before.header, ns=before.ns, id=before.id, action=Marker.DELETE)
                for key, before in self._shown.items()
                if key not in now
            ]
        self._shown = now
        return MarkerArray(markers=[*gone, *markers.markers])
