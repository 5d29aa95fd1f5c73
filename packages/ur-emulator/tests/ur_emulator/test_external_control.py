"""External control as UR's client library does it: a program that connects to its driver, by control periods.

The program is this project's own, with the wire formats and functions of the client library's. A user's copy of that
library's program runs with `benchmarks/external_control.py`.
"""

import math
import socket
from pathlib import Path

import numpy as np
import pytest

from tests.ur_emulator.external_control import PORTS, Driver, Mode, Point, Result
from tests.ur_emulator.ticking import PLAYS, Bench
from tests.waiting import until
from ur_core.processes.system import LOCAL
from ur_emulator.addresses import free_address
from ur_emulator.emulated_controller import EmulatedController
from ur_emulator.profile import profile_of
from ur_emulator.virtual.virtual_system import VirtualProcess, VirtualSystem, World

TEMPLATE = (Path(__file__).parent / "external_control.urscript").read_text()


class Rig:
    """Controller and driver on one network in memory. The driver serves after each control period."""

    def __init__(self, family):
        world = World()
        controller, driver = (
            VirtualSystem(VirtualProcess(world, None, name), Path()) for name in ("controller", "driver")
        )
        self.bench = Bench(family, system=controller, unlock_wait_s=0.1)
        self.driver = Driver(driver, "127.0.0.1")
        self.bench.run(self.driver.script(TEMPLATE, self.bench.profile.version))
        self.tick(5)
        assert self.driver.connected

    def tick(self, count=1):
        for _ in range(count):
            self.bench.tick()
            self.driver.serve()

    def result(self, within_s=10.0, keep_alive=True):
        """Return the result of a trajectory."""
        for _ in range(round(within_s / self.bench.tick_s)):
            if keep_alive:
                self.driver.keep_alive()
            self.tick()
            result = self.driver.result()
            if result is not None:
                return result
        raise AssertionError("no result came")

    @property
    def texts(self):
        return b"".join(self.bench.controller.messages).decode("latin-1")


@pytest.fixture(params=["cb3", "e-series"])
def rig(request):
    return Rig(request.param)


def test_the_script_is_that_of_the_controllers_version(rig):
    assert f"family {'cb3' if rig.bench.tick_s > 0.002 else 'e-series'}" in rig.texts


def test_setpoints_of_every_control_period_are_executed(rig):
    start, count = rig.bench.q.copy(), 200
    sent = [start + 0.05 * (1 - math.cos(0.02 * k)) for k in range(count)]
    for q in sent:
        rig.driver.write(Mode.SERVOJ, q)
        rig.tick()
    executed = [each[1] for each in rig.bench.controller.setpoints]
    np.testing.assert_allclose(executed, sent, atol=0.5e-6)


def test_a_missing_setpoint_is_extrapolated_while_the_program_waits_for_the_next(rig):
    start = rig.bench.q.copy()
    for k in range(60):
        if k % 3:
            rig.driver.write(Mode.SERVOJ, start + 0.0004 * k)
        rig.tick()
    assert rig.bench.controller.setpoints_count == 59  # from the first message on, one in every control period
    targets = np.array([each[1][0] for each in rig.bench.controller.setpoints])
    assert np.abs(np.diff(targets) - 0.0004).max() < 0.0004


def test_a_silent_driver_ends_the_program_and_stops_the_arm(rig):
    rig.driver.timeout_s = 0.1
    for _ in range(10):
        rig.driver.write(Mode.SERVOJ, rig.bench.q + 0.002)
        rig.tick()
    rig.tick(round(0.1 / rig.bench.tick_s))
    assert rig.bench.state in PLAYS
    rig.bench.until(lambda: rig.bench.state not in PLAYS, round(1.0 / rig.bench.tick_s))
    assert "no command in time" in rig.texts
    assert rig.driver.ended()


def test_a_driver_that_ends_ends_the_program(rig):
    rig.driver.write(Mode.SERVOJ, rig.bench.q)
    rig.tick(3)
    rig.driver.close()
    rig.bench.until(lambda: rig.bench.state not in PLAYS, round(1.0 / rig.bench.tick_s))


def test_a_spline_reaches_its_points_and_rests(rig):
    start, count = rig.bench.q.copy(), 4
    rig.driver.start(count)
    for k in range(1, count + 1):
        rig.driver.spline(start + 0.05 * k, [0.1 * (k < count)] * 6, 0.5)
    assert rig.result() is Result.SUCCESS
    np.testing.assert_allclose(rig.bench.q, start + 0.05 * count, atol=2e-5)
    assert not rig.bench.qd.any()


def test_moves_of_the_trajectory_interface(rig):
    goal = rig.bench.q + 0.1
    rig.driver.start(1)
    rig.driver.move(goal, Point.MOVEJ, v=1.0, a=2.0)
    assert rig.result() is Result.SUCCESS
    np.testing.assert_allclose(rig.bench.q, goal, atol=1e-6)


def test_a_trajectory_is_cancelled_while_it_runs(rig):
    goal = rig.bench.q + 1.0
    rig.driver.timeout_s = 2.0
    rig.driver.start(1)
    rig.driver.move(goal, Point.MOVEJ, v=0.5, a=2.0)
    rig.tick(100)
    assert rig.bench.qd.any()
    rig.driver.cancel()
    assert rig.result() is Result.CANCELED
    rig.tick(2)
    assert not rig.bench.qd.any()
    assert np.abs(rig.bench.q - goal).min() > 0.1


def test_a_missing_point_is_a_failure(rig):
    rig.driver.start(2)
    rig.driver.move(rig.bench.q + 0.02, Point.MOVEJ, v=1.0, a=2.0)
    assert rig.result() is Result.FAILURE


def test_script_commands_act_while_the_arm_follows(rig):
    for k in range(20):
        rig.driver.write(Mode.SERVOJ, rig.bench.q)
        if k == 5:
            rig.driver.command(1, [2.5, 0.0, 0.0, 0.05])
            rig.driver.command(10, [0.0, 0.0, 0.2])
        rig.tick()
    assert rig.bench.controller.payload.mass_kg == 2.5
    assert rig.bench.controller.motion.tcp[2] == 0.2
    assert rig.bench.state in PLAYS


def test_a_stop_ends_the_program_and_all_connections(rig):
    rig.driver.write(Mode.SERVOJ, rig.bench.q)
    rig.tick(3)
    rig.driver.write(Mode.STOPPED)
    rig.bench.until(lambda: rig.bench.state not in PLAYS, round(1.0 / rig.bench.tick_s))
    assert rig.driver.ended()
    assert not len(rig.bench.controller.sockets)


def test_a_protective_stop_pauses_and_play_goes_on(rig):
    rig.driver.timeout_s = 0.0  # the program waits without limit
    rig.driver.write(Mode.SERVOJ, rig.bench.q)
    rig.tick(10)
    rig.bench.controller.protective_stop("C209A0", "test")
    rig.tick(round(0.3 / rig.bench.tick_s))
    assert not rig.driver.ended()
    rig.bench.pendant.unlock_protective_stop()
    rig.bench.pendant.play()
    rig.driver.write(Mode.SERVOJ, rig.bench.q)
    rig.tick(round(0.5 / rig.bench.tick_s))
    assert rig.bench.state in PLAYS


def test_a_trajectory_over_tcp_by_a_program_file(tmp_path):
    """The dashboard loads and plays the program. It connects to its driver by TCP, and moves the simulated arm."""
    driver = Driver(LOCAL, free_address(), {name: PORTS[name] for name in ("reverse", "trajectory", "command")})
    driver.timeout_s = 0.0
    script = driver.script(TEMPLATE, profile_of("cb3").version)
    (tmp_path / "external_control.script").write_text(script)
    with EmulatedController("ur10", plant="nominal", programs=str(tmp_path)) as controller:
        with socket.create_connection((controller.host, 29999)) as client, client.makefile("rw") as lines:
            assert lines.readline().startswith("Connected")
            for line, answer in (("load external_control.urp", "Loading program"), ("play", "Starting program")):
                lines.write(f"{line}\n")
                lines.flush()
                assert lines.readline().startswith(answer)
        until(lambda: driver.serve() or driver.connected)
        start = np.array(controller.ask("state", names=["actual_q"])["actual_q"])
        driver.start(2)
        for k in (1, 2):
            driver.spline(start - 0.05 * k, [-0.1 * (k < 2)] * 6, 0.5)
        until(lambda: driver.result() is not None)
        end = np.array(controller.ask("state", names=["actual_q"])["actual_q"])
        np.testing.assert_allclose(end, start - 0.1, atol=1e-3)
        driver.write(Mode.STOPPED)
        controller.wait_for("runtime_state", 1)
        until(driver.ended)
    driver.close()
