"""No bytes from a client do more than end its session, however they are split."""

import random
import tracemalloc
from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.rtde_bytes import RECEIVED, SERVOJ, VERSION_2, RtdeBench, data, inputs, message, outputs
from ur_core.errors import ProtocolError
from ur_emulator.controller.rtde_variables import output_types

PACKETS = 1_000_000

OTHERS = ["input_int_register_1", "speed_slider_fraction", "input_bit_registers0_to_31", "external_force_torque"]

CONVERSATION = [
    VERSION_2,
    message("v"),
    outputs(RECEIVED, 125.0),
    inputs(SERVOJ),
    inputs(OTHERS),
    message("S"),
    data(1, "i11d", 11, *range(11)),
    data(2, "idI6d", 3, 0.5, 7, *range(6)),
    data(1, "i", 4),
    data(2, "i9d", 5, *range(9)),
    message("M", b"\x02hi\x01x\x03"),
    message("x", b"?"),
    message("P"),
    outputs(["timestamp", "nothing"], -1.0),
]


def pieces(stream, rng):
    while stream:
        size = rng.choice((1, 2, 3, 7, 50, 2000))
        yield stream[:size]
        stream = stream[size:]


def mutated(packet, rng):
    packet = bytearray(packet)
    for _ in range(rng.choice((0,) * 12 + (1, 1, 2, 8))):
        kind = rng.randrange(4)
        place = rng.randrange(len(packet) + 1)
        if kind == 0 and place < len(packet):
            packet[place] = rng.randrange(256)
        elif kind == 1 and place < len(packet):
            packet[place] ^= 1 << rng.randrange(8)
        elif kind == 2:
            packet[place:place] = rng.randbytes(rng.choice((1, 3, 9)))
        else:
            del packet[place : place + rng.choice((1, 2, 30))]
    if len(packet) >= 2 and rng.random() < 0.7:  # else most of them end the session by a wrong size
        packet[:2] = len(packet).to_bytes(2, "big")
    return bytes(packet)


def test_mutated_conversations_do_no_more_than_end_their_session():
    rng = random.Random(30004)
    controller = RtdeBench()
    port, sent, conversations = controller.port, 0, 0
    ended = packages = taken = tick = 0
    longest = max(len(kind.name) for kind in output_types(controller.profile).values())
    while sent < scaled(PACKETS):
        # Now and then again on the same connection: a wrong size may have left it in the middle of a frame.
        burst = [mutated(packet, rng) for packet in CONVERSATION * rng.choice((1, 1, 1, 8))]
        if rng.random() < 0.1:
            burst.insert(rng.randrange(len(burst)), rng.randbytes(rng.randrange(40)))
        sent += len(burst)
        conversations += 1
        session = port.open()
        try:
            for piece in pieces(b"".join(burst), rng):
                assert len(session.receive(piece)) <= len(piece) * longest + 65536
                tick += 1
                packages += bool(session.publish(tick))
        except ProtocolError:
            ended += 1
        taken += session.data_packages
        session.close()
        assert port.owners == {}
        controller.forwarded.clear()
    # It is no test if the sessions end before anything happens, or never end.
    assert 0.1 * conversations < ended < 0.9 * conversations
    assert packages > 0.1 * conversations
    assert taken > conversations
    assert all(-(2**31) <= number < 2**31 for number in controller.registers.input_int)


def test_random_bytes_do_no_more_than_end_their_session():
    rng = random.Random(1)
    port = RtdeBench().port
    for _ in range(scaled(100_000)):
        session = port.open()
        try:
            for piece in pieces(rng.randbytes(rng.randrange(200)), rng):
                session.receive(piece)
        except ProtocolError:
            continue
        session.close()
    assert port.owners == {}


def test_memory_stays_flat():
    controller = RtdeBench()
    session = controller.session(inputs(OTHERS))
    # Parts of frames that never end, and long runs of valid and unknown frames.
    unfinished = b"\xff\xffU" + bytes(60_000)
    stream = b"".join(CONVERSATION[6:7] * 500) + message("x", bytes(100)) * 500

    def rounds(count):
        for _ in range(count):
            waiting = controller.port.open()
            waiting.receive(unfinished)
            waiting.close()
            session.receive(stream)
            controller.forwarded.clear()

    session.receive(inputs(SERVOJ))
    tracemalloc.start()
    try:
        rounds(2)
        before, _ = tracemalloc.get_traced_memory()
        rounds(scaled(200))
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 20_000


def test_many_small_frames_in_one_piece_are_cut_in_linear_work():
    session = RtdeBench().session()
    # Were every frame taken off the front of the buffer, these would move 75 GB.
    count = 500_000 // 2
    session.receive(message("x") * count)
    assert session.unknown_packages == count


request = st.one_of(
    st.sampled_from(CONVERSATION),
    st.builds(lambda numbers: data(1, "i11d", 1, *numbers), st.lists(st.floats(), min_size=11, max_size=11)),
    st.builds(lambda number, tail: data(2, "id", number, 0.5) + tail, st.integers(-5, 5), st.just(b"")),
    st.builds(lambda names: outputs(names), st.lists(st.sampled_from([*RECEIVED, "no", ""]), max_size=4)),
    st.builds(lambda names: inputs(names), st.lists(st.sampled_from([*SERVOJ, *OTHERS, "no"]), max_size=4)),
)


@settings(max_examples=scaled(2000))
@given(st.lists(request, max_size=12), st.lists(st.integers(0, 400), max_size=40))
def test_answers_and_registers_do_not_depend_on_the_pieces(requests, cuts):
    # The first recipes are there, so that no request ends the session: answers before an end go with it.
    stream = b"".join([*CONVERSATION[:5], *requests])
    results = []
    for bounds in ([], cuts, range(len(stream))):
        controller = RtdeBench()
        session = controller.port.open()
        places = [0, *sorted(min(cut, len(stream)) for cut in bounds), len(stream)]
        answers = b"".join(session.receive(stream[a:b]) for a, b in pairwise(places))
        counters = (session.data_packages, session.short_packages, session.long_packages, session.unknown_packages)
        results.append((answers, controller.written(), counters, session.started, session.publish(0)))
    assert results[0] == results[1] == results[2]
