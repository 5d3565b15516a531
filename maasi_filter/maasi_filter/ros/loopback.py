"""The loopback interface, over which nodes on one host discover each other."""

import socket

_ANY_PORT = 7400


def loopback_fault() -> str:
    """Return why the loopback interface is unusable and how to fix it; empty if it is usable."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(('127.0.0.1', _ANY_PORT))
        except OSError as error:
            return (
                'nodes need the loopback interface, which cannot be used '
                f'({error.strerror}): run sudo ip link set lo up'
            )
    return ''
