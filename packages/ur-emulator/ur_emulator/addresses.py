"""Ports and loopback addresses of emulated controllers. UR's ports are fixed, so each has its own address."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import random
from collections.abc import Collection
from typing import Final

from ur_core.errors import AddressError
from ur_core.processes.system import LOCAL, System
from ur_core.processes.transport import Listener

PORTS: Final = {
    "dashboard": 29999,
    "primary": 30001,
    "secondary": 30002,
    "realtime": 30003,
    "rtde": 30004,
    "gripper": 63352,
}
"""UR's ports, and the port of Robotiq's gripper server."""

_ATTEMPTS: Final = 200
_FIRST_NETWORK: Final = 64  # 127.64.0.0 and above, which other programs rarely use


def is_free(host: str, system: System = LOCAL) -> bool:
    """Return True if all of a controller's ports are free at an address.

    Raises:
        AddressError: The address cannot be used at all.
    """
    for port in PORTS.values():
        try:
            listening((host, port), system).close()
        except AddressError as error:
            cause = error.__cause__
            if isinstance(cause, OSError) and cause.errno == errno.EADDRINUSE:
                return False
            raise
    return True


def free_address(taken: Collection[str] = (), system: System = LOCAL) -> str:
    """Return a loopback address at which all of a controller's ports are free.

    Args:
        taken: Addresses to avoid.
        system: Network.

    Raises:
        AddressError: None was found.
    """
    # Other programs may search at the same time, so each searches in its own random order.
    order = random.Random(os.getpid() * 1_000_003 + random.getrandbits(32))
    reason = ""
    for _ in range(_ATTEMPTS):
        host = f"127.{order.randrange(_FIRST_NETWORK, 255)}.{order.randrange(1, 255)}.{order.randrange(1, 255)}"
        try:
            if host not in taken and is_free(host, system):
                return host
        except AddressError as error:
            reason = str(error)
            break
    raise AddressError(
        f"no free loopback address was found {reason and f'({reason})'}: name two with --left and --right"
    )


def checked_address(host: str, system: System = LOCAL) -> str:
    """Return the address if a controller can listen there.

    Raises:
        AddressError: It is no loopback address, is taken, or does not exist on this machine.
    """
    check_loopback(host)
    for port in PORTS.values():
        listening((host, port), system).close()
    return host


def listening(address: tuple[str, int], system: System = LOCAL, send_buffer_bytes: int = 0) -> Listener:
    """Return a listening port.

    Args:
        address: Host and port.
        system: Network.
        send_buffer_bytes: Of accepted connections; see `TcpListener`.

    Raises:
        AddressError: The address is taken, does not exist on this machine, or is no loopback address.
    """
    check_loopback(address[0])
    try:
        return system.listen(*address, send_buffer_bytes)
    except OSError as error:
        raise _named(address, error) from error


def check_loopback(host: object, who: str = "an emulated controller listens on") -> None:
    """Check that an address can only be reached from this machine.

    Args:
        host: The address.
        who: Beginning of the rule that the error states.

    Raises:
        AddressError: It is not written as an address of 127.0.0.0/8.
    """
    loopback = False
    with contextlib.suppress(ValueError):
        loopback = isinstance(host, str) and ipaddress.IPv4Address(host).is_loopback
    if not loopback:
        raise AddressError(f"{host!r} is no loopback address: {who} 127.0.0.0/8 only, such as 127.0.0.1")


def _named(address: tuple[str, int], error: OSError) -> AddressError:
    where = f"{address[0]}:{address[1]}"
    if error.errno == errno.EADDRINUSE:
        return AddressError(f"{where} is taken by another program: stop it, or choose another address of 127.0.0.0/8")
    if error.errno == errno.EADDRNOTAVAIL:
        return AddressError(
            f"{where} does not exist on this machine: on macOS, add it with `sudo ifconfig lo0 alias {address[0]} up`"
        )
    return AddressError(f"{where} cannot be listened on: {error}")
