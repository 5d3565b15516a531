"""The ROS parameters of a node: declared from its settings, read in *configure*."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import reduce
from typing import Any, Generic, TypeVar

from pydantic import ValidationError
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from maasi_filter.plugins import add_folders
from maasi_filter.ros.node_settings import NodeSettings
from maasi_filter.ros.parameters import (
    ParameterField,
    choices,
    flatten,
    parameter_fields,
    parameter_name,
    unflatten,
)

SettingsT = TypeVar('SettingsT', bound=NodeSettings)


class SettingsError(Exception):
    """Invalid parameters; the text says which and why."""


class NodeParameters(Generic[SettingsT]):
    """Declares the parameters of a node, and reads its settings from them.

    Parameters that were not set have the defaults of the settings: once the node is configured,
    the resolved ones (of a preset, for example), which depend on the parameters that were set.
    The node has to allow undeclared parameters: optional ones are declared only if they have a
    value, as a file of `ros2 param dump` cannot represent None.
    """

    def __init__(self, node: Node, model: type[SettingsT]) -> None:
        self._node = node
        self._model = model
        # Settings in use, until `release`.
        self._settings: SettingsT | None = None
        self._own_change = False
        # Parameters of rclpy, such as use_sim_time and start_type_description_service.
        self._foreign = set(node.list_parameters([], 0).names)
        given = {
            name: item.value
            for name, item in node._parameter_overrides.items()
            if not self._is_foreign(name) and item.value is not None
        }
        add_folders(given.get('plugin_path') or [])
        known = {item.name for item in parameter_fields(model, given)}
        #: Names of parameters that were set, by a file or at run time.
        self._given = set(given) & known
        self._declare(given)
        for name in sorted(set(given) - known):
            close = get_close_matches(name, sorted(known), 1)
            hint = f'; did you mean {close[0]}?' if close else ''
            node.get_logger().warning(f'parameter {name}: is not known, and ignored{hint}')
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._note)

    def read(self) -> SettingsT:
        """Return the settings, and lock them until `release`."""
        settings, problems = check(self._model, self._values())
        if settings is None:
            raise SettingsError('\n'.join(problems.values()))
        self._show(settings)
        self._settings = settings
        return settings

    def release(self) -> None:
        """Unlock all parameters."""
        self._settings = None

    def _values(self) -> dict[str, Any]:
        """Return the parameters that were set."""
        return {name: self._node.get_parameter(name).value for name in sorted(self._given)}

    def _show(self, settings: SettingsT) -> None:
        """Set the other parameters to their resolved values."""
        changes = [
            Parameter(name, value=value)
            for name, value in flatten(settings.resolved()).items()
            if name not in self._given
            and self._node.get_parameter_or(name, Parameter(name)).value != value
        ]
        if changes:
            with self._changing():
                self._node.set_parameters_atomically(changes)

    @contextmanager
    def _changing(self) -> Iterator[None]:
        self._own_change = True
        try:
            yield
        finally:
            self._own_change = False

    def _is_foreign(self, name: str) -> bool:
        return name in self._foreign or name.startswith('qos_overrides.')

    def _judge(self, parameters: list[Parameter]) -> SetParametersResult:
        """Return whether parameters may be set, and if not, why."""
        own = [item for item in parameters if not self._is_foreign(item.name)]
        reason = '' if self._own_change else self._objection(own)
        return SetParametersResult(successful=not reason, reason=reason)

    def _objection(self, own: Sequence[Parameter]) -> str:
        values = self._values() | {item.name: item.value for item in own}
        values = {name: value for name, value in values.items() if value is not None}
        known = {item.name for item in parameter_fields(self._model, values)}
        known |= {item.name for item in own if self._node.has_parameter(item.name)}
        _, problems = check(self._model, values)
        for item in own:
            if item.name not in known:
                return f'parameter {item.name}: is not known'
            if self._settings is not None and item.name not in self._model.live:
                return (
                    f'parameter {item.name}: is read in configure; set it while the node is '
                    'unconfigured (deactivate and cleanup before)'
                )
            # Errors of other parameters, or of several together, may still be corrected.
            wrong = [item.name] if self._settings is None else list(problems)
            found = [problems[name] for name in wrong if name in problems]
            if found and item.value is not None:
                return found[0]
        return ''

    def _note(self, parameters: list[Parameter]) -> None:
        """Apply what was set, and declare dependent parameters, such as those of a new robot."""
        if self._own_change:
            return
        own = [item for item in parameters if not self._is_foreign(item.name)]
        self._given -= {item.name for item in own}
        self._given |= {item.name for item in own if item.value is not None}
        if self._settings is None:
            with self._changing():
                self._declare(self._values())
            return
        # Change settings in use in place.
        changed, _ = check(self._model, self._values())
        for *path, last in (item.name.split('.') for item in own):
            target, source = (reduce(getattr, path, item) for item in (self._settings, changed))
            setattr(target, last, getattr(source, last))

    def _declare(self, given: Mapping[str, Any]) -> None:
        _, problems = check(self._model, given)
        for item in parameter_fields(self._model, given):
            present = self._node.has_parameter(item.name)
            if not present and (item.default is not None or item.name in given):
                # With a range, rclpy would refuse the value before this class can report the error.
                ranged = item.name not in problems
                self._node.declare_parameter(item.name, item.default, _descriptor(item, ranged))


def check(
    model: type[SettingsT], values: Mapping[str, Any]
) -> tuple[SettingsT | None, dict[str, str]]:
    """Return the settings of flat parameters, or None and the errors by name."""
    try:
        return model.model_validate(unflatten(model, values)), {}
    except ValidationError as error:
        items = error.errors()
    except ValueError as error:
        return None, {str(error).partition(':')[0]: f'parameter {error}'}
    problems: dict[str, str] = {}
    missing = []
    for item in items:
        name = parameter_name(model, item['loc'], values)
        if item['type'] == 'missing' or not values:
            missing.append(name)
        else:
            text = item['msg'].removeprefix('Value error, ')
            problems[name] = f'parameter {name}: {text}, read {item["input"]!r}'
    if missing:
        several = 's' if len(missing) > 1 else ''
        problems[missing[0]] = (
            f'parameter{several} {", ".join(missing)}: needed, but not set; '
            'start the node with --ros-args --params-file FILE'
        )
    return None, problems


def _descriptor(item: ParameterField, ranged: bool) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=item.info.description or '',
        additional_constraints=item.constraints,
        dynamic_typing=True,
    )
    low, high = item.bound('ge', 'gt'), item.bound('le', 'lt')
    kinds = [kind for kind in choices(item.info.annotation) if kind is not type(None)]
    if not ranged or low is high is None or kinds not in ([int], [float]):
        return descriptor
    most = sys.float_info.max
    if kinds == [float]:
        ends = -most if low is None else float(low), most if high is None else float(high)
        span = FloatingPointRange(from_value=ends[0], to_value=ends[1])
        descriptor.floating_point_range = [span]
    else:
        ends = -(2**63) if low is None else int(low), 2**63 - 1 if high is None else int(high)
        descriptor.integer_range = [IntegerRange(from_value=ends[0], to_value=ends[1])]
    return descriptor
