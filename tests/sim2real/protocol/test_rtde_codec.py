import pytest

from dual_ur10.errors import ProtocolError
from dual_ur10.sim2real.protocol.rtde_codec import Frames, frame, split_names, text_payload


def test_a_frame_is_size_kind_payload():
    assert frame(ord("S")) == b"\x00\x03S"
    assert frame(ord("U"), b"ab") == b"\x00\x05Uab"


def test_frames_are_cut_out_of_pieces():
    frames = Frames()
    assert list(frames.feed(b"\x00")) == []
    assert list(frames.feed(b"\x05U")) == []
    assert list(frames.feed(b"ab\x00\x03S\x00")) == [(ord("U"), b"ab"), (ord("S"), b"")]
    assert list(frames.feed(b"\x03P")) == [(ord("P"), b"")]


def test_the_largest_frame_passes():
    frames = Frames()
    whole = b"\xff\xffU" + bytes(65532)
    assert list(frames.feed(whole[:-1])) == []
    assert list(frames.feed(whole[-1:])) == [(ord("U"), bytes(65532))]


@pytest.mark.parametrize("size", [0, 1, 2])
def test_a_frame_smaller_than_its_header_is_an_error_after_those_before_it(size):
    cut = Frames().feed(b"\x00\x03S" + bytes([0, size, ord("S")]))
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
