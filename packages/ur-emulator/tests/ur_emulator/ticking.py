"""Controllers and cells that are ticked by hand, without processes and clocks."""

from __future__ import annotations

import dataclasses
import json
import struct
import time
from typing import Any

import numpy as np

from ur_core.kinematics.ur10 import JOINT_SPEED_RAD_S, NOMINAL_DH
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.modes import RobotBits, RobotMode, RuntimeState, SafetyBits, SafetyMode
from ur_core.protocol.primary_packet import PrimaryPacket
from ur_emulator.builtins.table import builtins_of
from ur_emulator.controller.controller import Controller
from ur_emulator.controller.pendant import Pendant
from ur_emulator.controller.reported_values import ArmReading
from ur_emulator.controller.safety import Demand
from ur_emulator.emulator import ControllerOptions, Emulator
from ur_emulator.ports.dashboard import Dashboard
from ur_emulator.ports.realtime_packet import RealtimePacket
from ur_emulator.profile import profile_of

HOME = [0.0, -1.57, 1.57, -1.57, -1.57, 0.0]
SUBSTEPS = 4
PLAYS = (RuntimeState.PLAYING, RuntimeState.RESUMING)
PAUSES = (RuntimeState.PAUSING, RuntimeState.PAUSED)

# A thread that counts control periods in output register 0.
COUNT = "thread c():\n while True:\n  write_output_integer_register(0, read_output_integer_register(0) + 1)\n"
COUNT += "  sync()\n end\nend\nh = run c()\n"


def program(body: str, name: str = "p") -> str:
    lines = "".join(f"  {line}\n" for line in body.splitlines())
    return f"def {name}():\n{lines}end\n"


class Bench:
    """One controller whose arm follows its reference at once.

    Every tick is checked: the reference has no jump, and no joint exceeds its speed.
    """

    def __init__(
        self, family: str = "cb3", *, powered: bool = True, system: System = LOCAL, **assumptions: Any
    ) -> None:
        profile = profile_of(family)
        assumed = dataclasses.replace(profile.assumptions, **assumptions)
        self.profile = dataclasses.replace(profile, assumptions=assumed)
        self.controller = Controller(
            "left",
            self.profile,
            np.array(HOME),
            SUBSTEPS,
            dh=NOMINAL_DH,
            builtins=builtins_of,
            powered=powered,
            system=system,
        )
        self.off = 0
        self.pendant = Pendant(self.controller, self._off)
        self.wrench = np.zeros(6)
        self.q = np.array(HOME)
        self.qd = np.zeros(6)
        self.moved = 0.0  # rad, in the last tick
        self._forbidden = 0  # ticks since when the arm must not be moved
        self._resting = 0  # ticks since when its program has been paused or has ended
        self._primary = PrimaryPacket(self.profile, NOMINAL_DH)
        self._realtime = RealtimePacket(self.profile)
        self._dashboard = Dashboard(self.profile, self.pendant)

    def _off(self) -> None:
        self.off += 1

    @property
    def state(self) -> int:
        return self.controller.values["runtime_state"]

    @property
    def tick_s(self) -> float:
        return self.profile.tick_s

    def run(self, text: str) -> None:
        self.controller.run_script(text)

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            self._tick()

    def until(self, condition: Any, most: int = 2000) -> int:
        for count in range(most):
            if condition():
                return count
            self.tick()
        raise AssertionError(f"not within {most} control periods; values {self.controller.values}")

    def passing(self, seconds: float) -> None:
        self.tick(round(seconds / self.tick_s))

    def _tick(self) -> None:
        controller = self.controller
        plan = controller.tick(ArmReading(self.q, self.qd, np.zeros(6), self.wrench.copy(), None))
        dt = self.tick_s / SUBSTEPS
        ends = plan[:, 0] + dt * plan[:, 1]
        np.testing.assert_allclose(plan[0, 0], self.q, atol=1e-9, err_msg="the reference jumped")
        np.testing.assert_allclose(plan[1:, 0], ends[:-1], atol=1e-9, err_msg="the reference jumped")
        assert (np.abs(plan[:, 1]) <= 1.1 * JOINT_SPEED_RAD_S + 1e-6).all(), "faster than the joints can be"
        before, self.q, self.qd = self.q, ends[-1], plan[-1, 1]
        np.testing.assert_allclose(controller.values["target_q"], self.q, atol=1e-9)
        self.moved = float(np.abs(self.q - before).max())
        self._stands()

    def _stands(self) -> None:
        """Check that the arm does not move where it must not."""
        controller = self.controller
        held = controller.safety.demand is not Demand.NONE
        self._forbidden = self._forbidden + 1 if held else 0
        self._resting = self._resting + 1 if self.state in (RuntimeState.PAUSED, RuntimeState.STOPPED) else 0
        stopping = round(self.profile.assumptions.stopping_s / self.tick_s) + 2
        if self._forbidden > stopping:
            assert self.moved == 0.0, f"moves by {self.moved} though it is stopped or has no power"
        if self._resting > 2 and not controller.motion.free:
            assert self.moved == 0.0, f"moves by {self.moved} though no program plays"
        if self._forbidden > 1:
            assert self.state not in PLAYS, "a program plays though the arm is stopped"

    def ask(self, line: str) -> str:
        return self._dashboard.answer(line)

    def robot_mode_data(self) -> dict[str, Any]:
        """Return the sub-package of that name, and the masterboard's safety mode, as 30001 sends them."""
        packet = self._primary.state(self.controller.values)
        found, at = {}, 5
        while at < len(packet):
            size, kind = struct.unpack_from(">iB", packet, at)
            found[kind] = packet[at + 5 : at + size]
            at += size
        names = ("time", "real", "enabled", "power", "emergency", "protective", "runs", "paused", "mode", "control")
        data = dict(zip((*names, "fraction", "scaling"), struct.unpack_from(">Q7?BBdd", found[0]), strict=True))
        return {**data, "safety": found[3][struct.calcsize(">IIBBddBBddffff")]}

    def agree(self) -> None:
        """Check that all reported values of the state agree."""
        values, safety, motion = self.controller.values, self.controller.safety, self.controller.motion
        mode, stop, state = values["robot_mode"], values["safety_mode"], values["runtime_state"]
        bits, robot = SafetyBits(values["safety_status_bits"]), RobotBits(values["robot_status_bits"])
        stopped = stop not in (SafetyMode.NORMAL, SafetyMode.REDUCED)
        assert values["safety_status"] == stop
        assert bool(bits & SafetyBits.STOPPED_DUE_TO_SAFETY) == stopped
        assert bool(bits & SafetyBits.NORMAL) == (stop == SafetyMode.NORMAL)
        if stop == SafetyMode.REDUCED:
            assert bits & SafetyBits.REDUCED
        for number, bit in (
            (SafetyMode.PROTECTIVE_STOP, SafetyBits.PROTECTIVE_STOPPED),
            (SafetyMode.RECOVERY, SafetyBits.RECOVERY),
            (SafetyMode.SAFEGUARD_STOP, SafetyBits.SAFEGUARD_STOPPED),
            (SafetyMode.SYSTEM_EMERGENCY_STOP, SafetyBits.SYSTEM_EMERGENCY_STOPPED | SafetyBits.EMERGENCY_STOPPED),
            (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyBits.ROBOT_EMERGENCY_STOPPED | SafetyBits.EMERGENCY_STOPPED),
            (SafetyMode.VIOLATION, SafetyBits.VIOLATION),
            (SafetyMode.FAULT, SafetyBits.FAULT),
        ):
            assert stop != number or bits & bit == bit, (stop, bits)
        assert bool(robot & RobotBits.POWER_ON) == (mode >= RobotMode.POWER_ON)
        assert bool(robot & RobotBits.PROGRAM_RUNNING) == (state in (*PLAYS, RuntimeState.PAUSING))
        assert (values["joint_mode"][0] == 253) == (mode == RobotMode.RUNNING)
        assert (values["joint_mode"][0] == 239) == (mode < RobotMode.POWER_ON)
        # The program.
        assert (self.controller.program.machine is None) == (state in (RuntimeState.STOPPING, RuntimeState.STOPPED))
        if safety.demand is Demand.STOP:
            assert state in (RuntimeState.STOPPING, RuntimeState.STOPPED)
        if state in (RuntimeState.PAUSED, RuntimeState.STOPPED) and not motion.free:
            assert not np.any(values["target_qd"])
        assert 0.0 <= values["speed_scaling"] <= 1.0
        # The same on the other ports.
        data = self.robot_mode_data()
        assert data["time"] == round(1e6 * values["timestamp"])
        assert data["power"] == bool(robot & RobotBits.POWER_ON)
        assert data["emergency"] == bool(bits & SafetyBits.EMERGENCY_STOPPED)
        assert data["protective"] == bool(bits & SafetyBits.PROTECTIVE_STOPPED)
        assert data["runs"] == (state in PLAYS)
        assert data["paused"] == (state in PAUSES)
        assert (data["mode"], data["safety"]) == (mode & 0xFF, stop)
        assert (data["fraction"], data["scaling"]) == (values["target_speed_fraction"], values["speed_scaling"])
        packet = self._realtime.pack(values)
        for at, name in ((756, "robot_mode"), (812, "safety_mode"), (1052, "runtime_state"), (1108, "safety_status")):
            assert struct.unpack_from(">d", packet, at) == (values[name],)
        name = SafetyMode(stop).name if stop in set(SafetyMode) else str(stop)
        assert self.ask("safetystatus") == f"Safetystatus: {name}"
        assert self.ask("safetymode").endswith("SAFEGUARD_STOP" if "SAFEGUARD" in name or stop in (13, 14) else name)
        assert self.ask("robotmode") == f"Robotmode: {RobotMode(mode).name}"
        assert self.ask("running") == f"Program running: {str(state in PLAYS).lower()}"
        assert self.ask("programState").split()[0] == (
            "PLAYING" if state in PLAYS else "PAUSED" if state in PAUSES else "STOPPED"
        )


class Ticked:
    """Emulator in this process."""

    def __init__(self, emulator: Emulator) -> None:
        self.emulator = emulator

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            self.emulator.tick()

    def serve(self, ticks: int = 1) -> None:
        """Run control periods in which clients are served, however long they take."""
        for _ in range(ticks):
            self.emulator._hub.poll(time.monotonic())
            self.emulator.tick()

    def line(self, text: str) -> dict[str, Any]:
        answer = json.loads(self.emulator._injection.answer(text))
        assert set(answer) == ({"ok", "value"} if answer["ok"] else {"ok", "error"})
        return answer

    def ask(self, do: str, **values: Any) -> dict[str, Any]:
        return self.line(json.dumps({"do": do, **values}))

    def get(self, do: str, **values: Any) -> Any:
        answer = self.ask(do, **values)
        assert answer["ok"], answer
        return answer["value"]

    def refused(self, do: str, **values: Any) -> str:
        answer = self.ask(do, **values)
        assert not answer["ok"], answer
        assert answer["error"]
        return answer["error"]

    def close(self) -> None:
        self.emulator.close()


class Lone(Ticked):
    """One controller by itself."""

    def __init__(self, **options: Any) -> None:
        super().__init__(Emulator(ControllerOptions.from_mapping({"plant": "nominal", **options})))
