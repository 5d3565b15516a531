"""Markers that a viewer shows, without stale ones."""

from __future__ import annotations

from visualization_msgs.msg import Marker, MarkerArray


class MarkerBoard:
    """
    Makes each array of markers replace the one before.

    The first array deletes whatever a viewer still shows of a node before this one; later arrays
    delete the markers that are no longer there. Nodes that publish on the same topic lose theirs
    with the first array too, until they publish again.

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
