"""Addresses of emulated controllers: loopback only, free, and one per controller."""

import socket

import pytest

from tests.ur_emulator.pairs import Pair
from ur_core.errors import AddressError
from ur_emulator import addresses
from ur_emulator.addresses import PORTS, checked_address, free_address, is_free

ELSEWHERE = ["0.0.0.0", "192.168.0.1", "10.0.0.2", "8.8.8.8", "localhost", "::1", "", "127.0.0", "127.1", "2130706433",
             "127.0.0.1.nip.io", "127.0.0.1 ", "0127.0.0.1", "::ffff:127.0.0.1", "ur10", "127.0.0.é",
             "127.0.0.1\0"]  # fmt: skip


@pytest.mark.parametrize("host", ELSEWHERE)
@pytest.mark.parametrize("check", [checked_address, is_free])
def test_other_addresses_are_refused(host, check):
    with pytest.raises(AddressError, match=r"loopback.*127\.0\.0\.1"):
        check(host)


@pytest.mark.parametrize("arm", ["left", "right"])
@pytest.mark.parametrize("host", ["0.0.0.0", "localhost", "::1"])
def test_controllers_do_not_start_elsewhere(arm, host):
    with pytest.raises(AddressError, match=r"127\.0\.0\.0/8"):
        Pair(**{arm: host})


def test_both_arms_need_an_address():
    host = free_address()
    with pytest.raises(AddressError, match=f"both arms have the address {host}"):
        Pair(left=host, right=host)
    assert is_free(host)


def test_free_addresses_are_free_and_apart():
    found = {free_address() for _ in range(20)}
    assert len(found) == 20
    for host in found:
        assert host.startswith("127.")
        assert int(host.split(".")[1]) >= 64
        assert checked_address(host) == host


@pytest.mark.parametrize("port", PORTS.values())
def test_an_address_is_not_free_if_one_port_is_taken(port):
    host = free_address()
    with socket.create_server((host, port)):
        assert not is_free(host)
        with pytest.raises(AddressError, match=f"{host}:{port} is taken"):
            checked_address(host)
    assert is_free(host)


def test_taken_addresses_are_not_found(monkeypatch):
    hosts = []
    real = addresses.is_free

    def second_only(host, system):
        hosts.append(host)
        return len(hosts) > 3 and real(host, system)

    monkeypatch.setattr(addresses, "is_free", second_only)
    assert free_address() == hosts[-1]
    assert len(hosts) == 4
    monkeypatch.setattr(addresses, "is_free", lambda *_: False)
    with pytest.raises(AddressError, match="--left and --right"):
        free_address()


def test_the_search_reports_a_single_loopback_address(monkeypatch):
    def none(host, system):
        raise AddressError(f"{host} does not exist on this machine")

    monkeypatch.setattr(addresses, "is_free", none)
    with pytest.raises(AddressError, match=r"does not exist.*--left and --right"):
        free_address()


def test_an_emulator_that_does_not_start_holds_no_address():
    left, right = free_address(), free_address()
    with socket.create_server((right, PORTS["rtde"])):
        with pytest.raises(AddressError, match=f"{right}:30004 is taken"):
            Pair(left=left, right=right)
        assert is_free(left)


def test_an_emulator_uses_and_frees_its_addresses():
    left, right = free_address(), free_address()
    cell = Pair(left=left, right=right)
    try:
        assert [server.host for server in cell.emulator.servers] == [left, right]
        assert not is_free(left)
        assert not is_free(right)
        with pytest.raises(AddressError, match=f"{left}:.* is taken"):
            Pair(left=left)
    finally:
        cell.close()
    assert is_free(left)
    assert is_free(right)


def test_two_emulators_find_different_addresses():
    first, second = Pair(), Pair()
    try:
        hosts = {server.host for cell in (first, second) for server in cell.emulator.servers}
        assert len(hosts) == 4
    finally:
        first.close()
        second.close()
