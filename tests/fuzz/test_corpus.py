"""Every input that fuzzing kept or found, once through its target, and changed seeds: no fuzzer is needed."""

import random
import struct
import time
from pathlib import Path

import pytest

from tests.fuzz.run import HANG_S
from tests.fuzz.seeds import SEEDS
from tests.fuzz.targets import TARGETS
from tests.soak import SOAK

CORPUS = Path(__file__).parent / "corpus"
MOST_BYTES = 300_000
LENGTHS = (0, 1, 2**31, 2**32 - 1, 2**62, 2**64 - 1)
VALUES = b"nan -inf true '' [] {} [[]] 1e400 -0.0 0x10 1_0 \0 \x1b \xc3\xa9 \xf0\x9f\x98\x80".split()
COUNTS = {"cell_file": (200, 10_000), "record_file": (400, 50_000)}  # outside of a soak, and in one


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_accepted(name):
    for data in SEEDS[name]:
        assert TARGETS[name](data)


@pytest.mark.parametrize("name", TARGETS)
def test_corpus_raises_nothing_unexpected(name):
    files = sorted((CORPUS / name).iterdir())
    assert files
    for file in files:
        try:
            TARGETS[name](file.read_bytes())
        except Exception as error:
            error.add_note(f"input: {file}")
            raise


def test_corpora_are_small_and_belong_to_targets():
    assert {each.name for each in CORPUS.iterdir()} == set(TARGETS)
    assert sum(each.stat().st_size for each in CORPUS.glob("*/*")) < MOST_BYTES


def mutated(data, words, chance):
    """Return bytes with one to four changes: in bits, lengths, numbers, words, values, lines, and their order."""
    data = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        at, size, kind = chance.randrange(len(data) + 1), chance.randint(1, 40), chance.randrange(11)
        if chance.random() < 0.5:  # where the structure of a long file is
            at = min(at, chance.randrange(4000))
        other = chance.randrange(len(data) + 1)
        lines = data.split(b"\n")
        row = chance.randrange(len(lines))
        if kind == 0 and at < len(data):
            data[at] ^= 1 << chance.randrange(8)
        elif kind == 1:
            data[at : at + 8] = struct.pack("<Q", chance.choice(LENGTHS))
        elif kind == 2:
            data[at : at + 8] = struct.pack("<d", chance.choice((float("nan"), float("inf"), 1e300)))
        elif kind == 3:
            del data[at : at + 5 * size]
        elif kind == 4:
            data[at:at] = chance.randbytes(size)
        elif kind == 5:
            del data[at:]
        elif kind == 6:
            data[at : at + size] = data[other : other + size]
        elif kind == 7:
            data[at : at + chance.randint(0, 3)] = chance.choice([*VALUES, *(each.encode() for each in words)])
        elif kind == 8:
            del lines[row]
            data = bytearray(b"\n").join(lines)
        elif kind == 9:
            lines[row], lines[-1] = lines[-1], lines[row]
            data = bytearray(b"\n").join(lines)
        elif b" = " in lines[row]:
            values = [*VALUES, *(each.split(b" = ")[1] for each in lines if b" = " in each)]
            lines[row] = lines[row].split(b" = ")[0] + b" = " + chance.choice(values)
            data = bytearray(b"\n").join(lines)
    return bytes(data)


@pytest.mark.parametrize("name", TARGETS)
def test_changed_seeds_raise_nothing_unexpected(name):
    chance, accepted, count = random.Random(0), 0, COUNTS.get(name, (100, 4_000))[SOAK]
    for number in range(count):
        data = mutated(SEEDS[name][number % len(SEEDS[name])], TARGETS[name].words, chance)
        begun = time.process_time()
        try:
            accepted += TARGETS[name](data)
        except Exception as error:
            error.add_note(f"input: {data!r}")
            raise
        assert time.process_time() - begun < HANG_S, data
    assert accepted > 0
    assert accepted < count or name not in COUNTS  # some servers refuse hardly anything
