"""Real-time interface, port 30003."""

import itertools

import pytest

from tests.conformance.wire import REALTIME_OFFSETS, Realtime, pose_distance

LENGTHS = {
    # Bytes of the packet, by the versions that brought the length.
    "e-series": [((5, 10), 1220), ((5, 9), 1140), ((5, 4), 1116), ((5, 0), 1108)],
    "cb3": [((3, 15), 1220), ((3, 14), 1140), ((3, 10), 1116), ((3, 5), 1108), ((3, 2), 1060), ((3, 0), 1044)],
}

SHARED = tuple(REALTIME_OFFSETS)


def matched(controller, names):
    """Return packets of 30003 and RTDE packages of the same control periods."""
    with controller.rtde(",".join(names)) as rtde, Realtime(controller.host) as realtime:
        packets = [realtime.packet() for _ in range(20)]
        last = packets[-1]["timestamp"]
        packages = rtde.until(lambda now: now["timestamp"] >= last, "the same control period on RTDE")
    half = controller.tick_s / 2
    pairs = [
        (packet, package)
        for packet in packets
        for package in packages
        if abs(packet["timestamp"] - package["timestamp"]) < half
    ]
    assert len(pairs) >= 10
    return pairs


def test_the_packet_has_the_length_of_the_version(controller):
    expected = next(length for since, length in LENGTHS[controller.family] if controller.version >= since)
    with Realtime(controller.host) as realtime:
        for _ in range(5):
            realtime.packet()
            assert realtime.length == expected


def test_a_packet_comes_every_control_period(controller):
    with Realtime(controller.host) as realtime:
        times = [realtime.packet()["timestamp"] for _ in range(60)]
    periods = [(b - a) / controller.tick_s for a, b in itertools.pairwise(times)]
    assert all(abs(each - round(each)) < 1e-3 and round(each) >= 1 for each in periods)
    assert sum(round(each) == 1 for each in periods) >= 54


def test_packets_agree_with_rtde(controller):
    for packet, package in matched(controller, SHARED):
        assert max(pose_distance(packet["actual_TCP_pose"], package["actual_TCP_pose"])) < 2e-3
        for name in set(SHARED) - {"actual_TCP_pose"}:
            # An arm at rest; a real one has noise.
            assert packet[name] == pytest.approx(package[name], abs=1e-3), name


def test_packets_report_a_running_program(controller):
    controller.call("while True:\n sync()\nend")
    with Realtime(controller.host) as realtime:
        for _ in range(1000):
            if realtime.packet()["runtime_state"] == 2:
                return
    pytest.fail("no packet said that the program runs")


def test_a_client_that_does_not_read_disturbs_no_other(controller):
    with Realtime(controller.host), controller.rtde("timestamp") as rtde:
        first = rtde.data()["timestamp"]
        rtde.until(lambda now: now["timestamp"] > first + 100 * controller.tick_s, "time to pass")
