"""Network interface and router that lead from this computer to a controller."""

from __future__ import annotations

import ipaddress
import sys
from pathlib import Path
from typing import Final, NamedTuple

ROUTES: Final = Path("/proc/net/route")
INTERFACES: Final = Path("/sys/class/net")

_UP: Final = 0x1
_MOST_BYTES: Final = 1 << 20


class Route(NamedTuple):
    """Route to a host.

    Attributes:
        interface: Name of the interface; "lo" for this computer itself.
        gateway: Address of the router, or None.
        default: True if the same interface has the default route.
        wireless: True for Wi-Fi.
    """

    interface: str
    gateway: str | None
    default: bool
    wireless: bool


def is_loopback(host: str) -> bool:
    """Return True for a loopback address."""
    return ipaddress.IPv4Address(host).is_loopback


def route_to(host: str, routes: Path = ROUTES, interfaces: Path = INTERFACES) -> Route | None:
    """Return the route to a host, or None if it cannot be determined: there is none, or this is not Linux.

    Args:
        host: IPv4 address.
        routes: Table of routes of the kernel.
        interfaces: Folder in which the kernel lists network interfaces.
    """
    if is_loopback(host):
        return Route("lo", None, False, False)
    if not sys.platform.startswith("linux"):
        return None
    try:
        with routes.open(encoding="ascii") as file:
            table = [row for row in map(_row, file.read(_MOST_BYTES).splitlines()[1:]) if row is not None]
    except (OSError, UnicodeDecodeError):
        return None
    address = int(ipaddress.IPv4Address(host))
    fitting = [row for row in table if address & row.mask == row.destination]
    if not fitting:
        return None
    # The most specific route wins; among equals, the one with the least metric.
    best = max(fitting, key=lambda row: (row.mask, -row.metric))
    return Route(
        best.interface,
        str(ipaddress.IPv4Address(best.gateway)) if best.gateway else None,
        any(row.mask == 0 and row.interface == best.interface for row in table),
        any((interfaces / best.interface / each).exists() for each in ("wireless", "phy80211")),
    )


class _Row(NamedTuple):
    interface: str
    destination: int
    gateway: int
    metric: int
    mask: int


def _row(line: str) -> _Row | None:
    """Return a line of the table, or None if it is not a route in use."""
    words = line.split()
    try:
        interface, destination, gateway, flags = words[0], words[1], words[2], int(words[3], 16)
        metric, mask = int(words[6]), words[7]
        if not flags & _UP or "/" in interface:
            return None
        return _Row(interface, _address(destination), _address(gateway), metric, _address(mask))
    except (IndexError, ValueError, OverflowError):
        return None


def _address(text: str) -> int:
    """Return an address from the kernel's text: bytes in network order, read as a number of this machine."""
    return int.from_bytes(int(text, 16).to_bytes(4, sys.byteorder), "big")
