"""Programs are split from a byte stream, whatever its pieces."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ur_core.errors import ProtocolError
from ur_emulator.script import Splitter
from ur_emulator.script.splitter import PROGRAM_MAX

FIRST = """def a():
  thread t():
    while True: # if only while
      if x == "end":
        sync()
      elif y:
        end_force_mode()
      end
    end
  end
  if z: g() end
  def h():
  end
end
"""
SECOND = "movej([0], a=1)\r\n"
THIRD = '  sec b():\r\n  textmsg("def \u00e4")\r\n  end # end\r\n'
STREAM = f'# hello\n\n{FIRST}\n \t\n$ 1 "def"\n{SECOND}{THIRD}{SECOND}'
PROGRAMS = [FIRST, SECOND, THIRD, SECOND]


def feed(splitter: Splitter, piece: bytes, count: int) -> None:
    for _ in range(count):
        splitter.feed(piece)


def test_a_whole_buffer() -> None:
    splitter = Splitter()
    assert (splitter.feed(STREAM.encode()), splitter.rest) == (PROGRAMS, b"")


def test_an_incomplete_program_is_left() -> None:
    splitter = Splitter()
    assert (splitter.feed(b"a()\ndef f():\n b()\nen"), splitter.rest) == (["a()\n"], b"def f():\n b()\nen")


@given(st.lists(st.integers(0, len(STREAM.encode()))))
def test_any_pieces_give_the_same_programs(cuts: list[int]) -> None:
    data, splitter = STREAM.encode(), Splitter()
    ends = [0, *sorted(cuts), len(data)]
    found = [each for start, end in pairwise(ends) for each in splitter.feed(data[start:end])]
    assert found == PROGRAMS
    assert splitter.rest == b""


def test_invalid_utf8_is_replaced() -> None:
    assert Splitter().feed(b"a() # \xff\n") == ["a() # \ufffd\n"]


@pytest.mark.parametrize("piece", [b"x" * 1000, b"def f():\n" + b" y()\n" * 100])
def test_a_program_without_an_end_is_not_waited_for(piece: bytes) -> None:
    splitter = Splitter()
    with pytest.raises(ProtocolError, match="close each def with end"):
        feed(splitter, piece, PROGRAM_MAX // len(piece) + 2)


def test_programs_that_end_are_not_added_up() -> None:
    splitter = Splitter()
    for _ in range(40):
        assert len(splitter.feed((b"y" * 99 + b"\n") * 400)) == 400
    for _ in range(40):
        assert len(splitter.feed(b"def f():\n" + b" y()\n" * 10_000 + b"end\n")) == 1
