"""Messages made from their definitions: good ones with a few fields gone wrong."""

import array
import importlib
import math

import numpy as np

FLOATS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -0.0, 1e30, -1.0, 0.5, 2.0, 361.0)
TEXTS = ('', 'map', 'nobody', '/', 'rover', 'a' * 5000, '\u2603\n\x01', '../..', '{}')
LENGTHS = (0, 1, 2, 5, 7, 300)
BYTES = (0, 1, 1000, 100_000)
TIMES = ((-1, 0), (-(2**31), 0), (2**31 - 1, 999_999_999), (0, 2**32 - 1), (10**6, 5), (0, 0))


def kind_of(name):
    """Return the class of a type such as `std_msgs/msg/Header`, or None."""
    package, space, short = name.split('/')
    module = importlib.import_module(f'{package}.{space}')
    if space != 'action':
        return getattr(module, short)
    action, _, service = short.rpartition('_')
    impl = getattr(module, action).Impl
    return {
        'SendGoal': impl.SendGoalService,
        'GetResult': impl.GetResultService,
        'FeedbackMessage': impl.FeedbackMessage,
    }.get(service)


class Corpus:
    """A seeded source of messages; good ones carry the name of a robot."""

    def __init__(self, seed, robot='rover'):
        self._random = np.random.default_rng(seed)
        self._robot = robot
        #: How many were made.
        self.made = 0

    def message(self, kind, frame, stamp):
        """Return a message with one to three fields gone wrong."""
        self.made += 1
        result = self.good(kind(), frame, stamp)
        leaves = list(_leaves(kind))
        for _ in range(int(self._random.integers(1, 4))):
            if leaves:
                self._spoil(result, leaves[self._random.integers(len(leaves))])
        return result

    def good(self, message, frame, stamp):
        """Fill in what makes a message acceptable."""
        fields = message.get_fields_and_field_types()
        if 'header' in fields:
            message.header.frame_id = frame
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
        if fields.get('stamp') == 'builtin_interfaces/Time':
            message.stamp.sec, message.stamp.nanosec = stamp
        if 'robot' in fields:
            message.robot = self._robot
        if fields.get('orientation') == 'geometry_msgs/Quaternion':
            message.orientation.w = 1.0
        for name, kind in fields.items():
            nested = '/' in kind and not kind.startswith('sequence') and '[' not in kind
            # What has `_` in its type is inside an action's own messages.
            if nested and name != 'header':
                self.good(getattr(message, name), frame, stamp)
        return message

    def _pick(self, choices):
        return choices[int(self._random.integers(len(choices)))]

    def _spoil(self, message, path):
        *parts, last = path
        for part in parts:
            message = getattr(message, part)
        kind = message.get_fields_and_field_types()[last]
        setattr(message, last, self._value(kind, getattr(message, last)))

    def _value(self, kind, before):
        if kind == 'builtin_interfaces/Time':
            sec, nanosec = self._pick(TIMES)
            before.sec, before.nanosec = sec, nanosec
            return before
        if kind.startswith('sequence<'):
            kind = kind.removeprefix('sequence<').rstrip('>').partition(',')[0]
            return self._array(kind, self._pick(BYTES if kind == 'uint8' else LENGTHS))
        if '[' in kind:
            kind, _, length = kind.rstrip(']').partition('[')
            return self._array(kind, int(length))
        return self._single(kind)

    def _array(self, kind, length):
        if kind == 'uint8' and length:
            data = self._random.integers(0, 256, length, dtype=np.uint8)
            return array.array('B', data.tobytes())
        if self._random.random() < 0.3:
            return [self._single(kind)] * length
        return [self._single(kind) for _ in range(length)]

    def _single(self, kind):
        if '/' in kind:
            made = self._name(kind)()
            for path in list(_leaves(type(made))):
                if self._random.random() < 0.3:
                    self._spoil(made, path)
            return made
        if kind.startswith('string'):
            return self._pick(TEXTS)
        if kind == 'boolean':
            return bool(self._random.integers(2))
        if kind in ('double', 'float'):
            value = self._pick(FLOATS)
            return (
                float(np.float32(value))
                if kind == 'float' and abs(value) < 1e38
                else (math.inf if kind == 'float' and math.isfinite(value) else value)
            )
        if kind == 'octet':
            return bytes([self._pick((0, 1, 255))])
        bits = int(kind.lstrip('uint'))
        if kind.startswith('u'):
            return self._pick((0, 1, 2, 2**bits - 1, 2 ** (bits - 1), 2 ** (bits - 2)))
        return self._pick((0, 1, -1, 2 ** (bits - 1) - 1, -(2 ** (bits - 1))))

    @staticmethod
    def _name(kind):
        package, _, short = kind.partition('/')
        return kind_of(f'{package}/msg/{short}')


def _leaves(kind, prefix=()):
    """Yield the paths of all fields that hold no message; stamps and arrays count as one."""
    for name, type_name in kind.get_fields_and_field_types().items():
        nested = '/' in type_name and not type_name.startswith('sequence') and '[' not in type_name
        if nested and type_name != 'builtin_interfaces/Time':
            inner = Corpus._name(type_name) if '_' not in type_name.partition('/')[2] else None
            if inner is not None:
                yield from _leaves(inner, (*prefix, name))
        else:
            yield (*prefix, name)
