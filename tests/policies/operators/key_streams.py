"""Streams of keys on a pseudo terminal: motion keys, sequences of other keys, and the stop key among them."""

import os
import pty
import select

from dual_ur10.policies.operators.keyboard import KEYS, MOTIONS, Keyboard

TYPED = [each.encode() for each in (*MOTIONS, *KEYS, "W", "X", "q")]
"""Keys that are themselves."""

SEQUENCES = [
    each.encode("latin-1")
    for each in (
        *(f"\x1b[{final}" for final in "ABCDHFZEIO"),  # arrows, home, end, shift and tabulator, focus
        *(f"\x1bO{final}" for final in "ABCDHFPQRSMjklmnopqrstuvwyI"),  # the same and the key pad, as applications ask
        *(f"\x1b[{number}~" for number in (*range(1, 7), *range(11, 25), 200, 201)),
        *(f"\x1b[1;{modifier}{final}" for modifier in range(2, 9) for final in "ABCDHFPQRS"),
        *(f"\x1b[[{final}" for final in "ABCDE"),  # of the Linux console
        *(f"\x1b[{final}" for final in "abcd"),  # of rxvt
        *(f"\x1b[2{final}" for final in "$^@"),
        "\x1b\x1b[A",
        "\x1b[<35;120;40M",
        "\x1b[97;5u",
    )
]
"""Sequences of keys with no letter of their own."""

_END = b"n"  # each stream has one, as its last key
_PIECES = 1000


def stops_lost(streams, draw):
    """Return how many stop keys were lost, each typed once among others at a random instant between random reads.

    Args:
        streams: Number of streams, on one pseudo terminal.
        draw: `random.Random`.
    """
    own, other = pty.openpty()
    keyboard, lost = Keyboard(file=other), 0
    others = [each for each in (*TYPED, *SEQUENCES, b"\x1b", b"\xc3\xa4") if each not in (b"x", b"X", _END)]
    for _ in range(streams):
        typed = [draw.choice(others) for _ in range(draw.randrange(40))]
        typed.insert(draw.randint(0, len(typed)), draw.choice((b"x", b"X")))
        data, found = b"".join(typed), set()
        ends = sorted(draw.randint(0, len(data)) for _ in range(draw.randrange(12)))
        for begin, end in zip([0, *ends], [*ends, len(data)], strict=True):
            os.write(own, data[begin:end])
            found |= keyboard.read().buttons
        os.write(own, b" " + _END)  # the space ends what looks like a sequence
        for _ in range(_PIECES):
            if "reset" in found:
                break
            select.select([other], [], [], 1.0)
            found |= keyboard.read().buttons
        lost += "stop" not in found
    keyboard.close()
    os.close(own)
    os.close(other)
    return lost
