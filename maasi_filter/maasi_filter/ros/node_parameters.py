"""The ROS parameters of a node: declared from its settings, read in *configure*."""

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
    unflatten,
)
from maasi_filter.wording import reason

SettingsT = TypeVar('SettingsT', bound=NodeSettings)


class SettingsError(Exception):
    """Invalid parameters, named with their reasons."""


class NodeParameters(Generic[SettingsT]):
    """Declares the parameters of a node, and reads its settings from them.

    Parameters that are not set have the default of the settings or, once configured, of a preset.
    Optional ones are declared only with a value, as `ros2 param dump` cannot store None.
    """

    def __init__(self, node: Node, model: type[SettingsT]) -> None:
        self._node, self._model = node, model
        # Settings in use, until `release`.
        self._settings: SettingsT | None = None
        self._changing = False
        # Parameters of rclpy, such as use_sim_time and start_type_description_service.
        self._foreign = ('qos_overrides.', *node.list_parameters([], 0).names)
        #: Values of the parameters that were set, by a file or at run time.
        self._given: dict[str, Any] = {}
        given = self._with(self._ours(node._parameter_overrides.values()))
        add_folders(given.get('plugin_path') or [])
        known = {item.name for item in parameter_fields(model, given)}
        self._given = {name: value for name, value in given.items() if name in known}
        self._complete()
        for name in sorted(set(given) - known):
            close = get_close_matches(name, sorted(known), 1)
            hint = f'; did you mean {close[0]}?' if close else ''
            node.get_logger().warning(f'parameter {name}: is unknown and ignored{hint}')
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._note)

    def read(self) -> SettingsT:
        """Return the settings, and lock them until `release`."""
        settings, problems = check(self._model, self._given)
        if settings is None:
            raise SettingsError('\n'.join(problems.values()))
        self._complete(settings.resolved())
        self._settings = settings
        return settings

    def release(self) -> None:
        """Unlock all parameters."""
        self._settings = None

    def _complete(self, resolved: SettingsT | None = None) -> None:
        """Declare missing parameters, such as those of a new robot, with resolved settings."""
        _, problems = check(self._model, self._given)
        self._changing = True
        for item in parameter_fields(self._model, self._given):
            present = self._node.has_parameter(item.name)
            if not present and (item.default is not None or item.name in self._given):
                # With a range, rclpy would refuse the value before this class can report the error.
                ranged = item.name not in problems
                self._node.declare_parameter(item.name, item.default, _descriptor(item, ranged))
        if resolved is not None:
            flat = {k: v for k, v in flatten(resolved).items() if k not in self._given}
            self._node.set_parameters_atomically([Parameter(k, value=v) for k, v in flat.items()])
        self._changing = False

    def _ours(self, parameters: Iterable[Parameter]) -> list[Parameter]:
        return [item for item in parameters if not item.name.startswith(self._foreign)]

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        objections = self._objections(self._ours(parameters))
        reason = '' if self._changing else next(objections, '')
        return SetParametersResult(successful=not reason, reason=reason)

    def _objections(self, ours: Sequence[Parameter]) -> Iterator[str]:
        values = self._with(ours)
        known = {item.name for item in parameter_fields(self._model, values)}
        _, problems = check(self._model, values)
        for item in ours:
            if item.name not in known and not self._node.has_parameter(item.name):
                yield f'parameter {item.name}: is unknown'
            elif self._settings is not None and item.name not in self._model.live:
                yield (
                    f'parameter {item.name}: is read in configure; set it while the node is '
                    'unconfigured (deactivate and cleanup before)'
                )
            elif item.value is not None:
                # Later changes can correct other parameters.
                wrong = [item.name] if self._settings is None else list(problems)
                yield from (problems[name] for name in wrong if name in problems)

    def _note(self, parameters: list[Parameter]) -> None:
        if self._changing:
            return
        ours = self._ours(parameters)
        self._given = self._with(ours)
        if self._settings is None:
            self._complete()
            return
        # Change settings in use in place.
        changed, _ = check(self._model, self._given)
        for *path, last in (item.name.split('.') for item in ours):
            target, source = (reduce(getattr, path, item) for item in (self._settings, changed))
            setattr(target, last, getattr(source, last))

    def _with(self, ours: Sequence[Parameter]) -> dict[str, Any]:
        values = self._given | {item.name: item.value for item in ours}
        return {name: value for name, value in values.items() if value is not None}


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
    fields = list(parameter_fields(model, values))
    problems: dict[str, str] = {}
    missing = []
    for item in items:
        keys = [str(key) for key in item['loc']]
        # Parameter with the error, or one of several.
        field = next(field for field in fields if all(map(str.__eq__, field.keys, keys)))
        name = '.'.join(field.name.split('.')[: len(keys)])
        if item['type'] == 'missing' or not values:
            missing.append(name)
        else:
            problems[name] = f'parameter {name}: {reason(item)}'
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
    kind, *others = (kind for kind in choices(item.info.annotation) if kind is not type(None))
    if ranged and kind in (int, float) and not others and not low is high is None:
        most = 2**63 - 1 if kind is int else sys.float_info.max
        first, last = kind(-most if low is None else low), kind(most if high is None else high)
        if kind is int:
            descriptor.integer_range = [IntegerRange(from_value=first, to_value=last)]
        else:
            span = FloatingPointRange(from_value=first, to_value=last)
            descriptor.floating_point_range = [span]
    return descriptor
