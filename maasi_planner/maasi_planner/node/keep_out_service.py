"""The service `search/keep_outs`, which changes the keep-outs of the team."""

from collections.abc import Callable

from maasi_filter.geometry.area import Area
from maasi_filter.ros.keep_outs import KeepOutTopic
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_msgs.srv import SetKeepOuts
from maasi_planner.node_settings import PlannerNodeSettings

_SERVICE = 'search/keep_outs'


class KeepOutService:
    """Checks the requested zones and publishes them; `on_change` receives each changed area."""

    def __init__(
        self, node: LockstepLifecycleNode[PlannerNodeSettings], on_change: Callable[[Area], None]
    ) -> None:
        self._node = node
        self._topic = KeepOutTopic(node, on_change, keep=True)
        service = node.permanent(
            _SERVICE,
            lambda: node.create_service(SetKeepOuts, _SERVICE, lambda _, answer: answer),
        )
        service.callback = self._change

    def _change(
        self, request: SetKeepOuts.Request, response: SetKeepOuts.Response
    ) -> SetKeepOuts.Response:
        try:
            if not self._node.active:
                raise ValueError('the planner is not active')
            self._topic.change(request.zones)
            response.message = f'active keep-outs: {len(request.zones)}'
            response.success = True
        except ValueError as error:
            response.message = str(error)
        return response
