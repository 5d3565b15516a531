"""Calls of compiled functions of a user's own from the kernels of the suite.

A kernel gets an address, so that it is compiled and cached once for all functions. Addresses hold
in one process only: what is saved has a number of the function too, from which
`renew_addresses` finds the address again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import carray, cfunc, njit, types
from numba.core import cgutils
from numba.core.dispatcher import Dispatcher
from numba.extending import intrinsic

from maasi_filter.arrays import FloatArray, IntArray

CUSTOM = 3
# Entries of the parameters; those before are as of the radial models.
REACH, NUMBER, ADDRESS = 4, 5, 6


class _Block(NamedTuple):
    """A function with its values, which must outlive all kernels that know its address."""

    function: Callable[..., float]
    compiled: Any
    values: FloatArray
    #: Addresses of the function and of the values, and their number.
    entries: IntArray


_blocks: dict[int, _Block] = {}
_retired: list[_Block] = []


@intrinsic
def _call(typing_context, address, forward, left, up):  # type: ignore[no-untyped-def]
    """Return the function of a block at an offset."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        integer, number = (context.get_value_type(kind) for kind in (types.int64, types.float64))
        block = builder.inttoptr(arguments[0], integer.as_pointer())
        entries = [builder.load(builder.gep(block, [integer(index)])) for index in range(3)]
        values = builder.inttoptr(entries[1], number.as_pointer())
        kind = cgutils.ir.FunctionType(number, [number] * 3 + [number.as_pointer(), integer])
        function = builder.inttoptr(entries[0], kind.as_pointer())
        return builder.call(function, [*arguments[1:], values, entries[2]])

    return types.float64(types.int64, types.float64, types.float64, types.float64), generate


@njit(cache=True, error_model='numpy')
def custom_probability(  # type: ignore[no-untyped-def]
    parameters, dx, dy, dz, cos_yaw, sin_yaw
):
    """Return pi of a function of one's own at an offset [m, map axes] from the sensor."""
    reach = parameters[REACH]
    if dx * dx + dy * dy + dz * dz > reach * reach:
        return 0.0
    forward = cos_yaw * dx + sin_yaw * dy
    left = cos_yaw * dy - sin_yaw * dx
    address = np.int64(parameters[ADDRESS])
    value = parameters[0] * _call(address, forward, left, dz)  # type: ignore[call-arg]
    # What is not a number is not above 0 either.
    return min(value, 1.0) if value > 0.0 else 0.0


def register(function: Callable[..., float], values: FloatArray) -> tuple[int, int]:
    """Return number and address of a function (forward, left, up, values) with its values.

    The number is the same in every process for the same name of the function and values.
    """
    name = f'{function.__module__}:{function.__qualname__}'
    digest = hashlib.sha256(name.encode() + b'\0' + values.tobytes()).digest()
    # Floats are exact up to 2^53.
    number = int.from_bytes(digest[:6], 'little')
    block = _blocks.get(number)
    if block is None or block.function is not function:
        if block is not None:
            # Redefined, as in a notebook; the old one may still be in use.
            _retired.append(block)
        compiled, own = _compiled(function), np.array(values, dtype=float)
        entries = np.array([compiled.address, own.ctypes.data, len(own)], np.int64)
        block = _blocks[number] = _Block(function, compiled, own, entries)
    return number, block.entries.ctypes.data


def renew_addresses(kinds: FloatArray, parameters: FloatArray) -> None:
    """Put the addresses of this process into saved parameters (n, PARAMETERS), in place."""
    for row in np.flatnonzero(kinds == CUSTOM).tolist():
        block = _blocks.get(int(parameters[row, NUMBER]))
        if block is None:
            raise ValueError(
                'it was saved with a detection model of your own, which no sensor of this process '
                'has: make the sensors, with the same settings, before it is loaded'
            )
        parameters[row, ADDRESS] = block.entries.ctypes.data


@cache
def _compiled(function: Callable[..., float]) -> Any:
    inner = function
    if not isinstance(function, Dispatcher):
        inner = njit(error_model='numpy')(function)
    number = types.float64

    @cfunc(number(number, number, number, types.CPointer(number), types.int64))
    def call(forward, left, up, values, size):  # type: ignore[no-untyped-def]  # pragma: no cover
        return inner(forward, left, up, carray(values, (size,)))

    return call
