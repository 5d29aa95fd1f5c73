"""Read-only RTDE client: its samples, that it never waits or writes, and its errors."""

import contextlib
import itertools
import math
import struct
import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.links.fake_servers import (
    ANSWERS,
    DEADLINE_S,
    rtde_data,
    rtde_frame,
    rtde_request,
    rtde_talk,
    serving,
    until_closed,
)
from tests.soak import scaled
from ur_core.errors import ClosedError, LinkError, ProtocolError, SettingsError
from ur_core.links.rtde_link import RtdeLink
from ur_core.links.rtde_stream import RtdeStream
from ur_core.processes.system import LOCAL
from ur_core.protocol.rtde import TYPES

NAMES = ("robot_mode", "actual_q")
VARIABLES = [("timestamp", TYPES["DOUBLE"]), ("robot_mode", TYPES["INT32"])]
HERE = "127.0.0.1"


def wait(link, condition, what, clock=LOCAL.clock):
    """Poll until a condition holds, and return the samples."""
    end = clock.now_s() + DEADLINE_S
    samples = []
    while not condition():
        assert clock.now_s() < end, f"waited {DEADLINE_S} s for {what}"
        clock.wait([link.fileno()], end)
        samples += link.poll()
    return samples


def more(link, count, clock=LOCAL.clock):
    aim = link.count + count
    return wait(link, lambda: link.count >= aim, f"{count} samples", clock)


def fault(link, clock=LOCAL.clock):
    """Poll until an error, and return its message."""
    end = clock.now_s() + DEADLINE_S
    while clock.now_s() < end:
        try:
            link.poll()
        except LinkError as error:
            return str(error)
        clock.sleep(0.001)
    pytest.fail(f"no error in {DEADLINE_S} s")


# With an emulated controller.


def test_samples_have_the_controllers_values_in_order(cb3):
    with RtdeLink(cb3.left, NAMES, system=cb3.system, name="left") as link:
        assert link.version[:2] == (3, 15)
        assert link.frequency_hz == 125.0
        assert link.variables == ("timestamp", *NAMES)
        before = cb3.clock.now_s()
        samples = more(link, 5, cb3.clock)
        expected = cb3.ask("state", arm="left", names=["actual_q"])["actual_q"]
    times = [each.timestamp_s for each in samples]
    assert times == sorted(set(times))
    assert all(each.values["robot_mode"] == 7 for each in samples)
    assert samples[-1].values["actual_q"] == pytest.approx(expected, abs=1e-3)
    assert samples[-1].values.keys() == {"timestamp", *NAMES}
    assert before <= samples[-1].arrival_s <= cb3.clock.now_s()
    assert samples[-1] is link.latest


def test_samples_come_at_the_requested_rate(cb3):
    with RtdeLink(cb3.left, NAMES, system=cb3.system, frequency_hz=25.0) as link:
        times = [each.timestamp_s for each in more(link, 4, cb3.clock)]
    assert [b - a for a, b in itertools.pairwise(times)] == pytest.approx([0.04] * (len(times) - 1))


def test_only_optional_variables_may_be_missing(cb3):
    with RtdeLink(cb3.left, NAMES, system=cb3.system, optional=("ft_raw_wrench", "payload")) as link:
        assert link.variables == ("timestamp", *NAMES, "payload")
        assert more(link, 1, cb3.clock)[-1].values["payload"] == 0.0
    with pytest.raises(
        LinkError, match=r"left arm, RTDE at .*3\.15\.8\.\d+ has no RTDE variables ft_raw_wrench;.*update"
    ):
        RtdeLink(cb3.left, (*NAMES, "ft_raw_wrench"), system=cb3.system, optional=("payload",), name="left")


def test_a_silent_controller_ages_and_polling_does_not_wait(cb3):
    with RtdeLink(cb3.left, NAMES, system=cb3.system) as link:
        more(link, 2, cb3.clock)
        cb3.ask("link", arm="left", port="rtde", mute=True)
        while link.poll():
            pass
        alive = cb3.clock.now_s() - link.age_s(cb3.clock.now_s())
        count = link.count
        for _ in range(1000):
            assert link.poll() == []
        assert link.count == count
        assert link.age_s(alive + 0.25) == pytest.approx(0.25, abs=1e-3)
        cb3.ask("link", arm="left", port="rtde", mute=False)
        more(link, 1, cb3.clock)
        assert link.age_s(cb3.clock.now_s()) < cb3.clock.now_s() - alive


def test_packages_whose_time_stalls_are_no_sign_of_life(cb3):
    with RtdeLink(cb3.left, NAMES, system=cb3.system) as link:
        now = more(link, 1, cb3.clock)[-1].timestamp_s + 100.0
        cb3.ask("override", arm="left", timestamp=now)
        wait(link, lambda: link.latest.timestamp_s == now, "the time to stall", cb3.clock)
        at = link.latest.arrival_s + 5.0
        age_s = link.age_s(at)
        more(link, 5, cb3.clock)
        assert link.latest.arrival_s > at - 5.0
        assert link.age_s(at) == age_s


def test_a_timestamp_that_goes_back_breaks_the_link(cb3):
    with RtdeLink(cb3.left, NAMES, system=cb3.system, name="left") as link:
        last = more(link, 2, cb3.clock)[-1]
        cb3.ask("override", arm="left", timestamp=0.001)
        text = fault(link, cb3.clock)
        assert f"left arm, RTDE at {cb3.left}:30004" in text
        assert "went back" in text
        assert link.latest.timestamp_s >= last.timestamp_s
        cb3.ask("override", arm="left", timestamp=None)
        for _ in range(3):
            with pytest.raises(LinkError, match="went back"):
                link.poll()
        end = cb3.clock.now_s() + DEADLINE_S
        while cb3.ask("clients", arm="left")["rtde"]:  # it does not reconnect
            assert cb3.clock.now_s() < end


@pytest.mark.parametrize(("reset", "text"), [(False, "closed the connection"), (True, "closed the connection|broke")])
def test_the_end_of_the_stream_is_an_error(cb3, reset, text):
    with RtdeLink(cb3.left, NAMES, system=cb3.system, name="left") as link:
        more(link, 1, cb3.clock)
        cb3.ask("drop", arm="left", port="rtde", reset=reset)
        found = fault(link, cb3.clock)
    assert any(each in found for each in text.split("|"))
    assert "left arm" in found


def test_a_corrupt_stream_is_an_error(cb3):
    with RtdeLink(cb3.left, ("robot_mode",), system=cb3.system) as link:
        more(link, 1, cb3.clock)
        cb3.ask("link", arm="left", port="rtde", corrupt=100_000)
        assert "RTDE" in fault(link, cb3.clock)


def test_a_controller_that_accepts_and_is_silent_is_an_error(cb3):
    cb3.ask("link", arm="left", port="rtde", half_open=True)
    with pytest.raises(LinkError, match=r"left arm, RTDE at .*no answer in time;"):
        RtdeLink(cb3.left, NAMES, system=cb3.system, timeout_s=0.3, name="left")


def test_a_refused_connection_is_named(cb3):
    cb3.ask("refuse", arm="left", port="rtde")
    with pytest.raises(LinkError, match=rf"left arm, RTDE at {cb3.left}:30004: no connection \(.*refused.*\); check"):
        RtdeLink(cb3.left, NAMES, system=cb3.system, name="left")


def test_links_of_both_arms_are_independent(cb3):
    with RtdeLink(cb3.left, NAMES, system=cb3.system) as left, RtdeLink(cb3.right, NAMES, system=cb3.system) as right:
        cb3.ask("drop", arm="left", port="rtde")
        fault(left, cb3.clock)
        more(right, 3, cb3.clock)


def test_a_closed_link(cb3):
    link = RtdeLink(cb3.left, NAMES, system=cb3.system)
    assert cb3.clock.wait([link.fileno()], cb3.clock.now_s() + DEADLINE_S)[0] == [link.fileno()]
    link.close()
    link.close()
    for use in (link.poll, link.fileno):
        with pytest.raises(ClosedError, match="closed"):
            use()


# With small servers.


def test_nothing_is_sent_after_the_start():
    sent = []

    def talk(connection):
        rtde_talk(connection)
        for tick in range(50):
            connection.sendall(rtde_data(1.0 + tick))
        sent.append(until_closed(connection))

    with serving(talk) as port, RtdeLink(HERE, ["robot_mode"], port=port) as link:
        wait(link, lambda: link.count == 50, "all samples")
        assert link.poll() == []
    assert sent == [b""]


def test_requests():
    asked = []

    def talk(connection):
        for kind in "VvOS":
            asked.append(rtde_request(connection))
            connection.sendall(rtde_frame(kind, ANSWERS[kind]))
        until_closed(connection)

    with serving(talk) as port:
        RtdeLink(HERE, ["robot_mode", "timestamp"], port=port).close()
    assert asked == [
        ("V", b"\0\2"),
        ("v", b""),
        ("O", struct.pack(">d", 125.0) + b"timestamp,robot_mode"),
        ("S", b""),
    ]


def test_pieces_and_texts_change_nothing():
    def talk(connection):
        text = rtde_frame("M", b"\2hi\2me\1")
        for kind in "VvO":
            rtde_request(connection)
            for byte in text + rtde_frame(kind, ANSWERS[kind]):
                connection.sendall(bytes([byte]))
        rtde_request(connection)
        stream = text + rtde_frame("S", b"\1") + rtde_data(1.0) + text + rtde_data(2.0, mode=-1)
        connection.sendall(stream[:-5])
        connection.sendall(stream[-5:])
        until_closed(connection)

    with serving(talk) as port, RtdeLink(HERE, ["robot_mode"], port=port) as link:
        wait(link, lambda: link.count == 2, "both samples")
        assert link.latest.values == {"timestamp": 2.0, "robot_mode": -1}


@pytest.mark.parametrize(
    ("answers", "text"),
    [
        ({"V": b"\0"}, "protocol version 2 was not accepted"),
        ({"v": b"\0" * 15}, "15 bytes as its version"),
        ({"O": b"\1DOUBLE"}, "1 types for 2 variables"),
        ({"O": b""}, "0 types for 2 variables"),
        ({"O": b"\1DOUBLE,STRING"}, "output recipe 1 with types DOUBLE, STRING"),
        ({"O": b"\0DOUBLE,INT32"}, "output recipe 0"),
        ({"O": b"\0NOT_FOUND,INT32"}, "has no RTDE variables timestamp"),
        ({"S": b"\0"}, "kind 83"),
        ({"S": b""}, "kind 83"),
    ],
)
def test_answers_that_are_not_valid(answers, text):
    with (
        serving(lambda connection: rtde_talk(connection, **answers)) as port,
        pytest.raises(LinkError, match=r"right arm, RTDE at 127\.0\.0\.1:.*; ") as caught,
    ):
        RtdeLink(HERE, ["robot_mode"], port=port, name="right")
    assert text in str(caught.value)


@pytest.mark.parametrize("first", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\0\1V", b"\0\4X\1", b"\0\4V\1\0\4V\1", b""])
def test_a_server_of_another_protocol_is_an_error(first):
    def talk(connection):
        rtde_request(connection)
        connection.sendall(first)

    with serving(talk) as port, pytest.raises(LinkError):
        RtdeLink(HERE, ["robot_mode"], port=port)


def test_a_server_that_sends_texts_only_is_an_error():
    def talk(connection):
        end = time.monotonic() + DEADLINE_S
        while time.monotonic() < end:
            connection.sendall(rtde_frame("M", b"\1a\0\3"))
            time.sleep(0.01)

    with serving(talk) as port, pytest.raises(LinkError, match="no answer in time"):
        RtdeLink(HERE, ["robot_mode"], port=port, timeout_s=0.3)


@pytest.mark.parametrize(
    ("package", "text"),
    [
        (rtde_data(2.0, recipe=2), "recipe 2"),
        (rtde_data(2.0)[:-1], ""),
        (rtde_frame("U"), "recipe no with 0 bytes"),
        (rtde_frame("U", b"\1" + b"\0" * 13), "with 14 bytes: expected are those of recipe 1, 13 bytes"),
        (rtde_data(math.nan), "timestamp is nan"),
        (rtde_data(math.inf), "timestamp is inf"),
        (rtde_data(0.5), "went back"),
        (b"\0\2U", "frame of 2 bytes"),
        (b"\xff\xffU", "frame of 65535 bytes: at most"),
        (rtde_frame("S", b"\1"), "kind 83"),
        (rtde_frame("P", b"\1"), "kind 80"),
        (b"", "closed the connection"),
    ],
)
def test_a_bad_package_in_the_stream_is_an_error(package, text):
    made = threading.Event()

    def talk(connection):
        rtde_talk(connection)
        assert made.wait(DEADLINE_S)
        connection.sendall(rtde_data(1.0) + package)

    with serving(talk) as port, RtdeLink(HERE, ["robot_mode"], port=port, name="left") as link:
        made.set()
        found = fault(link)
        assert link.latest.timestamp_s == 1.0
    assert text in found
    assert found.startswith("left arm, RTDE at 127.0.0.1:")


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"host": "localhost"}, "IPv4"),
        ({"host": ""}, "IPv4"),
        ({"variables": ["a,b"]}, "a,b"),
        ({"variables": ["a\n"]}, "letters"),
        ({"variables": ["robot_mode", "robot_mode"]}, "distinct"),
        ({"variables": "robot_mode"}, "list of distinct"),
        ({"optional": ["a b"]}, "a b"),
        ({"frequency_hz": 0.0}, "frequency_hz"),
        ({"frequency_hz": math.nan}, "frequency_hz"),
        ({"timeout_s": 0.0}, "timeout_s"),
        ({"timeout_s": math.inf}, "timeout_s"),
    ],
)
def test_arguments_that_are_not_legal(values, text):
    with pytest.raises(SettingsError, match=text):
        RtdeLink(**{"host": HERE, "variables": ["robot_mode"], **values})


# The stream alone.

STARTED = rtde_frame("S", b"\1")


def stream():
    return RtdeStream(1, VARIABLES, 10.0)


@settings(max_examples=scaled(2000))
@given(st.lists(st.integers(1, 40), max_size=30), st.integers(1, 10))
def test_the_cuts_between_bytes_do_not_matter(cuts, count):
    data = STARTED + b"".join(rtde_data(float(time_s), time_s) for time_s in range(count))
    whole, parts = stream(), stream()
    samples = whole.feed(data, 11.0)
    got, place = [], 0
    for size in [*cuts, len(data)]:
        got += parts.feed(data[place : place + size], 11.0)
        place += size
    assert got == samples
    assert [each.values["robot_mode"] for each in got] == list(range(count))


@settings(max_examples=scaled(20_000, 60))
@given(st.binary(max_size=200))
def test_random_bytes_are_a_protocol_error_or_nothing(data):
    found = stream()
    with contextlib.suppress(ProtocolError):
        found.feed(STARTED + rtde_data(1.0) + data, 11.0)
    assert found.latest.timestamp_s >= 1.0


@settings(max_examples=scaled(20_000, 60))
@given(st.integers(0, 10**9), st.integers(1, 255))
def test_a_changed_byte_is_found_or_is_in_a_value(where, change):
    package = bytearray(rtde_data(2.0))
    where %= len(package)
    package[where] ^= change
    found = stream()
    found.feed(STARTED + rtde_data(1.0), 11.0)
    if where < 4:  # length, kind, recipe; a shorter or longer package shows at once, or when the next has come
        try:
            found.feed(bytes(package) + rtde_data(3.0) * 50, 12.0)
        except ProtocolError:
            return
        # Only texts pass.
        assert bytes(package)[2] == ord("M")
    else:
        try:
            (sample,) = found.feed(bytes(package), 12.0)
        except ProtocolError:
            assert where < 12  # the timestamp went back, or is not finite
            return
        assert sample.values != {"timestamp": 2.0, "robot_mode": 7}


def test_before_the_first_sample_age_counts_from_the_start():
    found = stream()
    assert found.alive_s == 10.0
    found.feed(STARTED + rtde_data(0.0), 11.0)
    assert found.alive_s == 11.0
    found.feed(rtde_data(0.0), 12.0)
    assert (found.alive_s, found.latest.arrival_s) == (11.0, 12.0)


def test_texts_do_not_fill_the_log(caplog):
    found = stream()
    found.feed(STARTED + rtde_frame("M", b"\2hi\0\3") * 1000, 11.0)
    assert 0 < len(caplog.records) < 100
    assert "'hi'" in caplog.text
