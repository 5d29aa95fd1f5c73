"""Routes to controllers, read from tables of the kernel."""

import pytest

from dual_ur10.sim2real.commissioning.doctor import Route, is_loopback, route_to

HEADER = "Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT\n"


@pytest.fixture
def routes(tmp_path):
    """Function that writes a table of routes, as the kernel of a little-endian machine prints it, and interfaces."""

    def hexed(address):
        return "".join(f"{int(each):02X}" for each in reversed(address.split(".")))

    def make(*rows, wireless=()):
        lines = [
            f"{interface} {hexed(net)} {hexed(gateway)} {flags:04X} 0 0 {metric} {hexed(mask)} 0 0 0\n"
            for interface, net, gateway, flags, metric, mask in rows
        ]
        (tmp_path / "route").write_text(HEADER + "".join(lines))
        for interface in wireless:
            (tmp_path / interface / "wireless").mkdir(parents=True)
        return {"routes": tmp_path / "route", "interfaces": tmp_path}

    return make


DEFAULT = ("eth0", "0.0.0.0", "10.0.0.1", 3, 100, "0.0.0.0")
OFFICE = ("eth0", "10.0.0.0", "0.0.0.0", 1, 100, "255.255.255.0")
ARMS = ("eth1", "192.168.1.0", "0.0.0.0", 1, 0, "255.255.255.0")


def test_the_most_exact_route_is_taken(routes, monkeypatch):
    monkeypatch.setattr("sys.byteorder", "little")
    table = routes(DEFAULT, OFFICE, ARMS, wireless=["wlan0"])
    assert route_to("192.168.1.11", **table) == Route("eth1", None, False, False)
    assert route_to("10.0.0.7", **table) == Route("eth0", None, True, False)
    assert route_to("8.8.8.8", **table) == Route("eth0", "10.0.0.1", True, False)
    two = routes(ARMS, ("wlan0", "192.168.1.0", "0.0.0.0", 1, 600, "255.255.255.0"))
    assert route_to("192.168.1.11", **two).interface == "eth1"
    down = routes(("eth1", "192.168.1.0", "0.0.0.0", 0, 0, "255.255.255.0"), DEFAULT)
    assert route_to("192.168.1.11", **down).interface == "eth0"
    air = routes(("wlan0", "192.168.1.0", "0.0.0.0", 1, 600, "255.255.255.0"))
    assert route_to("192.168.1.11", **air) == Route("wlan0", None, False, True)


def test_a_route_that_cannot_be_determined_is_none(routes, tmp_path, monkeypatch):
    assert route_to("192.168.1.11", **routes(OFFICE)) is None
    assert route_to("192.168.1.11", tmp_path / "none") is None
    (tmp_path / "bad").write_text(HEADER + "eth0\nx y z w a b c d\n../.. 0 0 1 0 0 0 0\neth0 FFFFFFFFFF 0 1 0 0 0 0\n")
    assert route_to("192.168.1.11", tmp_path / "bad") is None
    (tmp_path / "binary").write_bytes(b"\xff\xfe\n" * 10)
    assert route_to("192.168.1.11", tmp_path / "binary") is None
    monkeypatch.setattr("sys.platform", "darwin")
    assert route_to("192.168.1.11", **routes(ARMS)) is None
    assert route_to("127.3.2.1", tmp_path / "none").interface == "lo"
    assert is_loopback("127.3.2.1")
    assert not is_loopback("128.0.0.1")
