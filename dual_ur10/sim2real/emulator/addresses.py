"""Ports and loopback addresses of emulated controllers. UR's ports are fixed, so each has its own address."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import socket
from collections.abc import Collection
from typing import Final

from dual_ur10.errors import AddressError

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


def is_free(host: str) -> bool:
    """Return True if all of a controller's ports are free at an address.

    Raises:
        AddressError: The address cannot be used at all.
    """
    for port in PORTS.values():
        try:
            listening((host, port)).close()
        except AddressError as error:
            cause = error.__cause__
            if isinstance(cause, OSError) and cause.errno == errno.EADDRINUSE:
                return False
            raise
    return True


def free_address(taken: Collection[str] = ()) -> str:
    """Return a loopback address at which all of a controller's ports are free.

    Args:
        taken: Addresses to avoid.

    Raises:
        AddressError: None was found.
    """
    # Other programs may search at the same time, so each searches in its own random order.
    order = random.Random(os.getpid() * 1_000_003 + random.getrandbits(32))
    reason = ""
    for _ in range(_ATTEMPTS):
        host = f"127.{order.randrange(_FIRST_NETWORK, 255)}.{order.randrange(1, 255)}.{order.randrange(1, 255)}"
        try:
            if host not in taken and is_free(host):
                return host
        except AddressError as error:
            reason = str(error)
            break
    raise AddressError(
        f"no free loopback address was found {reason and f'({reason})'}: name two with --left and --right"
    )


def checked_address(host: str) -> str:
    """Return the address if a controller can listen there.

    Raises:
        AddressError: It is no loopback address, is taken, or does not exist on this machine.
    """
    check_loopback(host)
    for port in PORTS.values():
        listening((host, port)).close()
    return host


def listening(address: tuple[str, int]) -> socket.socket:
    """Return a listening socket.

    Raises:
        AddressError: The address is taken, does not exist on this machine, or is no loopback address.
    """
    check_loopback(address[0])
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setblocking(False)
        sock.bind(address)
        sock.listen(64)
    except OSError as error:
        sock.close()
        raise _named(address, error) from error
    return sock


def check_loopback(host: str) -> None:
    """Check that an address can only be reached from this machine.

    Raises:
        AddressError: It is not written as an address of 127.0.0.0/8.
    """
    packed = b""
    with contextlib.suppress(OSError, ValueError, TypeError):
        packed = socket.inet_pton(socket.AF_INET, host)
    if packed[:1] != b"\x7f":
        raise AddressError(
            f"{host!r} is no loopback address: an emulated controller listens on 127.0.0.0/8 only, such as 127.0.0.1"
        )


def _named(address: tuple[str, int], error: OSError) -> AddressError:
    where = f"{address[0]}:{address[1]}"
    if error.errno == errno.EADDRINUSE:
        return AddressError(f"{where} is taken by another program: stop it, or choose another address of 127.0.0.0/8")
    if error.errno == errno.EADDRNOTAVAIL:
        return AddressError(
            f"{where} does not exist on this machine: on macOS, add it with `sudo ifconfig lo0 alias {address[0]} up`"
        )
    return AddressError(f"{where} cannot be listened on: {error}")
