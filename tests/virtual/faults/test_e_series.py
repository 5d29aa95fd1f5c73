"""Two e-Series controllers: rows 25, 26, 29, 36 and 39 of the table in `docs/reference/faults.md`."""

import pytest

from dual_ur10.errors import StartError
from tests.virtual.faults.lab import ARMS, VirtualLab


@pytest.fixture
def lab():
    made = VirtualLab(family="e-series")
    yield made
    made.close()


def test_25_26_one_robot_twice_and_swapped_robots_are_refused(lab):
    serial = {arm: f"20215{number:05d}" for number, arm in enumerate(ARMS, start=1)}
    for arm in ARMS:
        lab.cell.ask("pretend", arm=arm, serial_number=serial["left"])
    with pytest.raises(StartError, match=f"serial numbers {serial['left']} and {serial['left']}.*one controller"):
        lab.make()
    for arm in ARMS:
        lab.cell.ask("pretend", arm=arm, serial_number=serial[arm])
    lab.configure(**{arm: {"serial_number": serial[other]} for arm, other in zip(ARMS, ARMS[::-1], strict=True)})
    with pytest.raises(StartError, match=f"left, serial number: {serial['left']}, .*swapped"):
        lab.make()
    lab.assert_nothing_has_moved()


def test_36_39_local_mode_and_another_family_are_refused(lab):
    lab.cell.ask("remote", arm="right", on=False)
    lab.assert_refused("right, remote control: local, expected: remote; switch right to Remote Control on its pendant")
    lab.cell.ask("remote", arm="right", on=True)
    lab.configure(left={"family": "cb3", "model": "ur10"}, right={"family": "cb3", "model": "ur10"})
    lab.assert_refused("left, calibration: DH parameter d_m[0] is 0.1807", "expected: a UR10's kinematics")


def test_29_an_e_series_arm_that_stops_stops_both(lab):
    lab.begin()
    lab.assert_within_limits()
    lab.do("stop", arm="right", mode=3)
    lab.assert_stopped(
        lab.step_until_faulted(),
        "right: safety mode 3 (PROTECTIVE_STOP)",
        arms=["left"],
        ramped=["left"],
        seen_ticks=15,
    )
