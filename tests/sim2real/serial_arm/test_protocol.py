"""Frames on a serial line: any cut, loss or change of bytes, and payloads."""

import contextlib
import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.sim2real.serial_arm import protocol as serial_arm
from dual_ur10.sim2real.serial_arm.protocol import (
    ANSWER,
    FRAME_BYTES,
    MOST_PAYLOAD,
    Client,
    FrameScanner,
    Info,
    MotionState,
    Point,
    Request,
    SerialFrame,
    Status,
    crc16,
    encode,
)
from ur_core.errors import ProtocolError

frames = st.builds(SerialFrame, st.integers(0, 255), st.integers(0, 255), st.binary(max_size=MOST_PAYLOAD))
microns = st.integers(-(2**31), 2**31 - 1).map(lambda number: number / 1e6)
sixes = st.tuples(*[microns] * 6)


def test_the_checksum_is_the_published_one():
    assert crc16(b"123456789") == 0x29B1  # CRC-16/CCITT-FALSE


def test_the_largest_frame_fits_the_buffer_of_a_mega():
    assert len(encode(SerialFrame(0, 0, bytes(MOST_PAYLOAD)))) == FRAME_BYTES <= 64


@given(st.lists(frames, max_size=5), st.binary(max_size=40), st.data())
def test_frames_survive_cuts_and_bytes_between_them(sent, noise, data):
    noise = noise.replace(b"\xa5", b"")
    stream = b"".join(noise + encode(each) for each in sent) + noise
    scanner, found = FrameScanner(), []
    while stream:
        cut = data.draw(st.integers(1, len(stream)))
        found += scanner.feed(stream[:cut])
        stream = stream[cut:]
    assert found == sent


@given(frames, st.integers(0, 8 * FRAME_BYTES - 1), frames)
def test_a_changed_bit_never_gives_another_frame(sent, bit, following):
    data = bytearray(encode(sent))
    data[bit // 8 % len(data)] ^= 1 << bit % 8
    scanner = FrameScanner()
    assert [each for each in scanner.feed(bytes(data)) if each != sent] == []
    scanner.drop()
    assert list(scanner.feed(encode(following))) == [following]


@given(st.lists(st.binary(max_size=80), max_size=20))
def test_nonsense_is_bounded(pieces):
    scanner = FrameScanner()
    for piece in pieces:
        list(scanner.feed(piece))
        assert len(scanner._rest) <= FRAME_BYTES


def test_late_and_foreign_answers_are_skipped():
    client = Client()
    client.request(Request.CLEAR)
    frame = client.request(Request.STATUS)
    sequence = next(FrameScanner().feed(frame)).sequence
    answers = [(sequence - 1, Request.STATUS), (sequence, Request.CLEAR), (sequence, Request.STATUS)]
    data = [encode(SerialFrame(number, kind | ANSWER, bytes([kind]))) for number, kind in answers]
    assert client.feed(data[0] + data[1]) is None
    assert client.feed(data[2]) == bytes([Request.STATUS])


def test_sequences_of_neighbours_differ_and_are_never_that_of_a_hello():
    client, seen = Client(), []
    for _ in range(600):
        seen.append(next(FrameScanner().feed(client.request(Request.STATUS))).sequence)
    assert 0 not in seen
    assert all(a != b for a, b in itertools.pairwise(seen))
    assert next(FrameScanner().feed(client.request(Request.HELLO))).sequence == 0


@given(st.integers(0, 1), st.integers(0, 255), st.integers(0, 2**32 - 1).map(lambda number: number / 1e6), sixes, sixes)
def test_points_travel_in_whole_microradians(arm, number, time_s, q, qd):
    point = Point(arm, number, time_s, q, qd)
    payload = serial_arm.pack_point(point)
    assert len(payload) <= MOST_PAYLOAD
    assert serial_arm.unpack_point(payload) == point


@given(st.sampled_from(MotionState), st.booleans(), st.booleans(), st.lists(sixes, min_size=1, max_size=2))
def test_a_status_fits_a_frame_with_two_arms(state, known, by_watchdog, q):
    status = Status(state, known, 1.25, by_watchdog, tuple(q))
    data = serial_arm.pack_status(status)
    assert len(data) + 1 <= MOST_PAYLOAD
    assert serial_arm.unpack_status(data) == status


def test_an_answer_to_another_hello_is_refused():
    info = Info(1, ("left", "right"), 36, 0xFFFFFFFF, 7)
    data = serial_arm.pack_info(serial_arm.pack_nonce(5), info)
    assert serial_arm.unpack_info(5, data) == info
    with pytest.raises(ProtocolError, match="another HELLO"):
        serial_arm.unpack_info(6, data)


@pytest.mark.parametrize("mask", [0, 4, 255])
def test_arms_that_do_not_exist_are_refused(mask):
    data = bytearray(serial_arm.pack_info(serial_arm.pack_nonce(5), Info(1, ("left",), 36, 1, 1)))
    data[5] = mask
    with pytest.raises(ProtocolError, match="arms"):
        serial_arm.unpack_info(5, bytes(data))


@given(st.binary(max_size=MOST_PAYLOAD))
def test_any_bytes_as_a_status_are_a_status_or_refused(data):
    with contextlib.suppress(ProtocolError):
        serial_arm.unpack_status(data)
