"""The loopback interface, through which nodes on one host discover each other."""

import socket

_ANY_PORT = 7400


def loopback_fault() -> str:
    """Return why the loopback interface cannot be used and what mends it; empty if it can."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(('127.0.0.1', _ANY_PORT))
        except OSError as error:
            return (
                f'the loopback interface cannot be used ({error.strerror}), and nodes talk '
                'through it: sudo ip link set lo up'
            )
    return ''
