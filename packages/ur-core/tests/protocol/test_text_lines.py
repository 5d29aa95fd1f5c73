import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from ur_core.errors import ProtocolError
from ur_core.protocol.text_lines import LineReader


def test_lines_end_with_or_without_a_carriage_return():
    reader = LineReader()
    assert reader.feed(b"play\r\nst") == ["play"]
    assert reader.feed(b"op\n\nx\xff\ry\n") == ["stop", "", "x\ufffd\ry"]


@given(st.lists(st.binary(max_size=40), max_size=30))
@settings(max_examples=scaled(2000, 40))
def test_lines_do_not_depend_on_the_cuts_between_bytes(chunks):
    reader, whole = LineReader(60), b"".join(chunks)
    got: list[str] = []
    try:
        for chunk in chunks:
            got += reader.feed(chunk)
    except ProtocolError:
        assert max(map(len, whole.split(b"\n"))) > 60
    else:
        expected = whole.split(b"\n")
        assert max(map(len, expected)) <= 60
        assert got == [line.removesuffix(b"\r").decode("utf-8", "replace") for line in expected[:-1]]


def test_a_line_without_end_is_refused_and_dropped():
    reader = LineReader()
    assert reader.feed(b"x" * 4096) == []
    with pytest.raises(ProtocolError, match="4096"):
        reader.feed(b"x")
    with pytest.raises(ProtocolError):
        reader.feed(b"\n")
    with pytest.raises(ProtocolError):
        reader.feed(b"ok\n")
    assert LineReader().feed(b"x" * 4096 + b"\n") == ["x" * 4096]
    with pytest.raises(ProtocolError):
        LineReader().feed(b"x" * 4097 + b"\n")
