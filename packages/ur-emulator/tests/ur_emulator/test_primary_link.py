"""Facts from the primary interface, and the errors of a faulty one."""

import contextlib
import dataclasses
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.links.fake_servers import serving, until_closed
from tests.soak import scaled
from ur_core.errors import LinkError, ProtocolError, SettingsError
from ur_core.kinematics.robots import MODEL_OF_FAMILY
from ur_core.kinematics.ur10 import DH_A_M, DH_ALPHA_RAD, DH_D_M, DHParameters, nominal_dh
from ur_core.links.primary_link import _Reader, read_primary
from ur_core.protocol.primary_messages import text_message, version_message
from ur_core.protocol.primary_packet import PrimaryPacket, kinematics_checksums
from ur_emulator.controller.rtde_variables import zero_values
from ur_emulator.profile import PROFILES

HERE = "127.0.0.1"
PROFILE = PROFILES["cb3"]
CALIBRATED = DHParameters(
    a_m=tuple(DH_A_M + 0.001 * np.arange(6)),
    d_m=tuple(DH_D_M - 0.0005),
    alpha_rad=tuple(DH_ALPHA_RAD + 0.002),
    theta_rad=(0.01, -0.02, 0.03, 0.0, 1e-9, -0.04),
    robot="ur10",
)


def state(kinematics=CALIBRATED, profile=PROFILE):
    return PrimaryPacket(profile, kinematics).state(zero_values(profile))


def sub_package(kind, data=b""):
    return struct.pack(">iB", 5 + len(data), kind) + data


def packet(kind, body=b""):
    return struct.pack(">iB", 5 + len(body), kind) + body


def test_facts_of_an_emulated_controller(cell):
    family = cell.description["left"]["family"]
    nominal = nominal_dh(MODEL_OF_FAMILY[family])
    profile = PROFILES[family]
    facts = read_primary(cell.left, system=cell.system)
    assert facts.version == profile.version
    assert facts.robot_type == 2
    assert facts.dh(nominal.robot) == nominal
    assert facts.checksums == kinematics_checksums(nominal)
    assert facts.safety_checksum == profile.safety_checksum
    cell.ask("calibration", arm="left", error_m=0.003)
    cell.ask("pretend", arm="left", robot_type=1, safety_checksum=0xFEDCBA98)
    facts = read_primary(cell.left, system=cell.system)
    assert facts.robot_type == 1
    assert facts.safety_checksum == 0xFEDCBA98
    assert np.subtract(facts.a_m, nominal.a_m) == pytest.approx([0.0, 0.003, 0.0, 0.0, 0.0, 0.0], abs=1e-12)
    assert facts.checksums != kinematics_checksums(nominal)
    for fault in ({"mute": True}, {"half_open": True}):
        cell.ask("link", arm="left", port="primary", **fault)
        with pytest.raises(LinkError, match=r"left arm, primary interface at .*30001: no answer in time; "):
            read_primary(cell.left, 0.3, name="left", system=cell.system)
        cell.ask("heal", arm="left")


def test_rows_are_not_confused_and_pieces_do_not_matter():
    data = version_message(PROFILE) + text_message(1.0, "hello") + packet(25, b"later versions") + state()

    def talk(connection):
        for start in range(0, len(data), 7):
            connection.sendall(data[start : start + 7])
        until_closed(connection)

    with serving(talk) as port:
        facts = read_primary(HERE, 10.0, port)
    assert facts.dh("ur10") == CALIBRATED
    assert facts.checksums == kinematics_checksums(CALIBRATED)


def test_facts_may_come_in_several_packets():
    reader = _Reader()
    whole = state()
    reader.feed(packet(16) + whole)
    assert reader.facts is None
    reader.feed(version_message(dataclasses.replace(PROFILE, version=(5, 11, 1, 2))) + packet(16))
    assert reader.facts.version == (5, 11, 1, 2)
    assert reader.facts.dh("ur10") == CALIBRATED


def test_another_robots_kinematics_are_read_and_refused_as_a_ur10s():
    reader = _Reader()
    data = bytearray(version_message(PROFILE) + state())
    place = bytes(data).index(struct.pack(">d", CALIBRATED.a_m[1]))
    data[place : place + 8] = struct.pack(">d", -0.425)  # a UR5's
    reader.feed(bytes(data))
    assert reader.facts.a_m[1] == -0.425
    with pytest.raises(SettingsError, match="another robot"):
        reader.facts.dh("ur10")


VERSION = version_message(PROFILE)
WHOLE = VERSION + state()


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (struct.pack(">iB", 4, 16), "packet of 4 bytes"),
        (struct.pack(">iB", -1, 16), "packet of -1 bytes"),
        (b"HTTP/1.1 400 Bad Request\r\n", "packet of 1213486160 bytes"),
        (VERSION + packet(16, sub_package(5, b"\0" * 20)), "too short"),
        (VERSION + packet(16, sub_package(6, b"\0" * 20)), "too short"),
        (VERSION + packet(16, sub_package(10, b"\0" * 3)), "too short"),
        (VERSION + packet(16, struct.pack(">iB", 4, 5)), "sub-package 5 of 4 bytes"),
        (VERSION + packet(16, struct.pack(">iB", 500, 5)), "sub-package 5 of 500 bytes"),
        (VERSION + packet(16, b"\0\0"), "too short"),
        (packet(20, b"\0" * 9 + b"\3\xff\0"), "too short"),
        (VERSION + packet(16) * 300, "packets without"),
        (VERSION, "closed the connection"),
        (b"", "closed the connection"),
    ],
)
def test_data_that_are_not_valid(data, text):
    with (
        serving(lambda connection: connection.sendall(data)) as port,
        pytest.raises(LinkError, match=text) as caught,
    ):
        read_primary(HERE, 5.0, port, name="right")
    assert str(caught.value).startswith("right arm, primary interface at 127.0.0.1:")


def test_nothing_is_sent():
    sent = []

    def talk(connection):
        connection.sendall(VERSION + state())
        sent.append(until_closed(connection))

    with serving(talk) as port:
        read_primary(HERE, 5.0, port)
    assert sent == [b""]


@settings(max_examples=scaled(20_000, 60))
@given(st.integers(0, 10**6), st.binary(min_size=1, max_size=8))
def test_changed_bytes_are_a_protocol_error_or_values(place, junk):
    data = bytearray(WHOLE)
    place %= len(data)
    data[place : place + len(junk)] = junk
    reader = _Reader()
    with contextlib.suppress(ProtocolError):
        reader.feed(bytes(data))
        if reader.facts is not None:
            with contextlib.suppress(SettingsError):
                reader.facts.dh("ur10")
