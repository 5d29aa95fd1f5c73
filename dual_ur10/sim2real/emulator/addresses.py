"""Loopback addresses for emulated controllers: free ones are found, since UR's ports cannot be chosen."""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Collection
from typing import Final

from dual_ur10.errors import AddressError
from dual_ur10.sim2real.emulator.arm_server import PORTS
from dual_ur10.sim2real.emulator.sockets import check_loopback, listening

_ATTEMPTS: Final = 200
_FIRST_NETWORK: Final = 64  # 127.64.0.0 and above: away from what other programs use


def is_free(host: str) -> bool:
    """Whether all of a controller's ports are free at an address.

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
    """A loopback address at which all of a controller's ports are free.

    Args:
        taken: Addresses that are not to be used.

    Raises:
        AddressError: None was found.
    """
    # Other programs may look at the same time: everyone looks in an order of its own.
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
    """The address, if a controller can listen there.

    Raises:
        AddressError: It is not of the loopback interface, taken, or does not exist on this machine.
    """
    check_loopback(host)
    for port in PORTS.values():
        listening((host, port)).close()
    return host
