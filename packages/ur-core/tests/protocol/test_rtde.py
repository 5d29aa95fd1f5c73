import math
import struct

import numpy as np
import pytest

from ur_core.errors import ProtocolError, SettingsError
from ur_core.protocol.rtde import TYPES, FrameReader, frame, split_names, text_payload


def test_a_frame_is_size_kind_payload():
    assert frame(ord("S")) == b"\x00\x03S"
    assert frame(ord("U"), b"ab") == b"\x00\x05Uab"


def test_frames_are_cut_out_of_pieces():
    frames = FrameReader()
    assert list(frames.feed(b"\x00")) == []
    assert list(frames.feed(b"\x05U")) == []
    assert list(frames.feed(b"ab\x00\x03S\x00")) == [(ord("U"), b"ab"), (ord("S"), b"")]
    assert list(frames.feed(b"\x03P")) == [(ord("P"), b"")]


def test_the_largest_frame_passes():
    frames = FrameReader()
    whole = b"\xff\xffU" + bytes(65532)
    assert list(frames.feed(whole[:-1])) == []
    assert list(frames.feed(whole[-1:])) == [(ord("U"), bytes(65532))]


@pytest.mark.parametrize("size", [0, 1, 2])
def test_a_frame_smaller_than_its_header_is_an_error(size):
    cut = FrameReader().feed(b"\x00\x03S" + bytes([0, size, ord("S")]))
    assert next(cut) == (ord("S"), b"")
    with pytest.raises(ProtocolError, match=f"{size} bytes"):
        next(cut)


def test_names_are_separated_by_commas():
    assert split_names(b"") == []
    assert split_names(b"a,b") == split_names(b"a,b,") == ["a", "b"]
    assert split_names(b"\xff,a b,") == ["\xff", "a b"]


def test_text_messages_of_both_versions():
    assert text_payload("stop", "arm", 2, version=2) == b"\x04stop\x03arm\x02"
    assert text_payload("stop", "arm", 2, version=1) == b"\x02stop"


def test_long_texts_are_cut_off():
    payload = text_payload("x" * 300, "y" * 300, 3, version=2)
    assert payload == b"\xff" + b"x" * 255 + b"\xff" + b"y" * 255 + b"\x03"


def test_sizes_are_those_of_the_rtde_guide():
    sizes = {name: struct.calcsize(f">{kind.count}{kind.code}") for name, kind in TYPES.items()}
    assert sizes == {
        "BOOL": 1,
        "UINT8": 1,
        "UINT32": 4,
        "UINT64": 8,
        "INT32": 4,
        "DOUBLE": 8,
        "VECTOR3D": 24,
        "VECTOR6D": 48,
        "VECTOR6INT32": 24,
        "VECTOR6UINT32": 24,
    }


def test_zeros_have_the_types_python_would_use():
    assert TYPES["DOUBLE"].zero == 0.0
    assert isinstance(TYPES["DOUBLE"].zero, float)
    assert isinstance(TYPES["INT32"].zero, int)
    assert TYPES["BOOL"].zero is False
    assert TYPES["VECTOR3D"].zero == (0.0, 0.0, 0.0)
    assert TYPES["VECTOR6INT32"].zero == (0,) * 6


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        ("UINT8", 256 + 7, 7),
        ("UINT8", -1, 255),
        ("UINT32", 1 << 40 | 5, 5),
        ("UINT64", -1, (1 << 64) - 1),
        ("INT32", 1 << 31, -(1 << 31)),
        ("INT32", -(1 << 31) - 1, (1 << 31) - 1),
        ("INT32", 2.9, 2),
        ("INT32", math.nan, 0),
        ("UINT32", -math.inf, 0),
        ("INT32", np.int64(-3), -3),
        ("DOUBLE", 10**400, math.inf),
        ("DOUBLE", -(10**400), -math.inf),
        ("DOUBLE", math.inf, math.inf),
        ("BOOL", 7, True),
    ],
)
def test_numbers_are_made_to_fit(kind, value, expected):
    assert TYPES[kind].fit("x", value) == [expected]
    struct.pack(">" + TYPES[kind].code, *TYPES[kind].fit("x", value))


def test_nan_passes_in_doubles():
    assert math.isnan(TYPES["VECTOR3D"].fit("x", (0.0, math.nan, 1.0))[1])


@pytest.mark.parametrize(
    ("kind", "value"), [("VECTOR6D", (1.0,) * 5), ("VECTOR6D", 1.0), ("DOUBLE", "?"), ("INT32", None)]
)
def test_other_values_are_refused_by_name(kind, value):
    with pytest.raises(SettingsError, match="actual_q"):
        TYPES[kind].fit("actual_q", value)
