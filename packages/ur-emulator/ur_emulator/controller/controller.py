"""One emulated UR controller: the work of one control period."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ur_core.errors import OperationRefusedError, ScriptError
from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.rotations import cross
from ur_core.kinematics.ur10 import DHParameters
from ur_core.processes.system import LOCAL, System
from ur_core.protocol import primary_messages as messages
from ur_core.protocol.modes import JointMode, RobotBits, RobotMode, RuntimeState, SafetyMode
from ur_core.types import Array
from ur_emulator.controller.inputs_outputs import InputsOutputs
from ur_emulator.controller.program_runner import ProgramRunner
from ur_emulator.controller.received import Received
from ur_emulator.controller.registers import Registers, Watchdog
from ur_emulator.controller.reported_values import GRAVITY_M_S2, ArmReading, ReportedValues
from ur_emulator.controller.safety import Demand, Safety
from ur_emulator.controller.script_sockets import ScriptSockets
from ur_emulator.motion import JointTorques, MotionGenerator
from ur_emulator.motion.tool_kinematics import Tcp
from ur_emulator.profile import ControllerProfile
from ur_emulator.script import Builtins, Program

log = logging.getLogger(__name__)

_POWERED: Final = (RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.RUNNING)
_PLAYS: Final = (RuntimeState.PLAYING, RuntimeState.RESUMING, RuntimeState.PAUSING)
_ROBOT_BITS: Final = (  # by power, and by a running program: operations on flags are slow
    (RobotBits(0), RobotBits.PROGRAM_RUNNING),
    (RobotBits.POWER_ON, RobotBits.POWER_ON | RobotBits.PROGRAM_RUNNING),
)
_RUNNING: Final = (int(JointMode.RUNNING),) * 6

_HISTORY: Final = 1000  # control periods of joint positions and forces kept for programs
_SETPOINTS: Final = 50_000  # executed servoj targets kept
_MESSAGES: Final = 256

_LEVELS: Final[dict[int, messages.ReportLevel]] = {
    SafetyMode.PROTECTIVE_STOP: messages.ReportLevel.WARNING,
    SafetyMode.FAULT: messages.ReportLevel.FAULT,
}
"""Severity of stops as reported, others VIOLATION. That of a protective stop: the tests of UR's client library."""

_ENCODER_RAD: Final = 1e-12  # smallest motion that is measured: a solver leaves less than 1e-18 rad in an arm at rest

STEADY_RAD: Final = 0.01
STEADY_RAD_S: Final = 0.001
STEADY_S: Final = 0.5
"""Time for which an arm has to stand until it is steady: UR's script manual."""

REDUCED_SPEED: Final = 0.5  # ratio of the speed in reduced mode; a real one depends on the safety configuration

SENSOR_S: Final = 0.1
"""Longest time between two wrenches of an external sensor: UR's script manual."""

CHARACTERS_PER_STEP: Final = 64
"""Characters of a text that count for one more statement of the program that sends it."""

Setpoint = tuple[int, tuple[float, ...], float, float, float]
"""One executed servoj target: control period, target, t, lookahead time and gain. A plain tuple of numbers, since the
garbage collector visits each kept named tuple in every collection."""


@dataclass
class Payload:
    """Payload as set on the controller."""

    mass_kg: float = 0.0
    cog_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    inertia_kg_m2: tuple[float, ...] = (0.0,) * 6


class Controller:
    """One UR controller, without its sockets.

    Args:
        name: "left" or "right", for the log.
        profile: Its version.
        q_rad: (6,) initial joint positions.
        substeps: Physics steps per control period.
        dh: Its nominal kinematics.
        builtins: Factory of the functions that its programs may call, such as `builtins_of`.
        lookahead_scale: Ratio of the true lookahead to the commanded one.
        gripper_kg: Payload mass declared by its installation.
        powered: Whether the arm is powered from the start.
        boot_s: Initial reading of its own clock.
        system: Network of the connections that its programs open.
    """

    def __init__(
        self,
        name: str,
        profile: ControllerProfile,
        q_rad: Array,
        substeps: int,
        *,
        dh: DHParameters,
        builtins: Callable[[Controller], Builtins],
        lookahead_scale: float = 1.0,
        gripper_kg: float = 0.0,
        powered: bool = True,
        boot_s: float = 100.0,
        system: System = LOCAL,
    ) -> None:
        self.name, self.profile = name, profile
        self.dh = dh
        self.ticks = 0
        self.boot_s = boot_s
        self.registers = Registers()
        self.received = Received(self.registers)
        self.io = InputsOutputs()
        self.sockets = ScriptSockets(system, name)
        self.safety = Safety(profile.assumptions, powered=powered)
        self._reported_mode = self.safety.safety_mode
        self.motion = MotionGenerator(
            profile.tick_s, substeps, q_rad, dh=dh, lookahead_scale=lookahead_scale, assumptions=profile.assumptions
        )
        self.payload = Payload(gripper_kg)
        self.reading = ArmReading(np.array(q_rad, dtype=float), np.zeros(6), np.zeros(6), np.zeros(6), None)
        self.previous = self.reading
        self._values = ReportedValues(profile, dh, self.reading, self.motion)
        self.gripper_kg = gripper_kg
        self.overrides: dict[str, Any] = {}
        self._overridden: dict[str, Any] = {}
        self.remote_control: bool | None = True  # None: its settings offer none, as those of URSim do
        self.history: deque[tuple[float, ...]] = deque(maxlen=_HISTORY)
        self.forces: deque[tuple[float, ...]] = deque(maxlen=_HISTORY)
        self.setpoints: deque[Setpoint] = deque(maxlen=_SETPOINTS)
        self.setpoints_count = 0
        self.external_sensor = False
        self.popup = ""
        self.messages: deque[bytes] = deque(maxlen=_MESSAGES)
        self.watchdogs: dict[str, Watchdog] = {}
        self._sensor_watchdog: Watchdog | None = None
        self.watchdog_acts = True
        self.wrench: Array = np.zeros(6)
        self._wanted: Array = np.array(q_rad, dtype=float)
        self._deviating = 0
        self._standing = 0  # control periods
        self._ran = False
        self._raw_wrench: Array = np.zeros(6)
        self._wrench_zero: Array = np.zeros(6)
        self.program = ProgramRunner(
            profile, self.motion, builtins(self), self._script_failed, self._announce, self.sockets.close_all
        )
        self._publish(np.zeros(6))

    @property
    def values(self) -> dict[str, Any]:
        """Values that are reported to clients, by RTDE name: always the same dictionary, complete for now."""
        self._values.complete()
        return self._values

    @property
    def time_s(self) -> float:
        """Time since the controller was started: RTDE's `timestamp`."""
        return self.boot_s + self.ticks * self.profile.tick_s

    def tick(self, reading: ArmReading) -> Array:
        """Begin one control period: measure, run the program, and plan the motion.

        Returns:
            (substeps, 3, 6): the motion, as `CellWorld.advance` takes it.
        """
        self.ticks += 1
        before_rad = self.reading.q_rad
        seen_rad = np.where(np.abs(reading.q_rad - before_rad) > _ENCODER_RAD, reading.q_rad, before_rad)
        reading = reading._replace(q_rad=seen_rad)
        self.previous, self.reading = self.reading, reading
        self._measure(reading)
        self.motion.observe(reading.q_rad, reading.qd_rad_s)
        self.safety.tick(self.profile.tick_s, at_rest=not self.motion.moving or self.program.scaling == 0.0)
        if self.safety.safety_mode != self._reported_mode:
            self._reported_mode = self.safety.safety_mode
            self.messages.append(messages.safety_mode_message(self.time_s, self._reported_mode))
        demand = self.safety.demand
        limit = REDUCED_SPEED if self.safety.reduced else 1.0
        self.program.tick(
            demand, may_move=self.safety.may_move, resumes=self.safety.resumes, slider=self.io.slider * limit
        )
        self._watch()
        if self._ran and self.program.machine is None:
            self.received.ended_tick = self.ticks
            if not self.profile.assumptions.output_registers_persist:
                self.registers.clear_outputs()
        self._ran = self.program.machine is not None
        before = self.motion.qd.copy()
        plan: Array = self.motion.plan(self.program.scaling, wrench=self.wrench, q_actual=reading.q_rad)
        self._standing = self._standing + 1 if self._stands else 0
        self._check_faults(reading)
        # Under torque control no acceleration is commanded.
        commanded = np.zeros(6) if self.motion.torques is not None else self.motion.qd - before
        self._publish(commanded / self.profile.tick_s)
        return plan

    @property
    def torques(self) -> JointTorques | None:
        """Torques of the planned control period, payload included; None in position control."""
        torques, weight = self.motion.torques, (self.payload.mass_kg - self.gripper_kg) * GRAVITY_M_S2
        if torques is None or not weight:
            return torques
        lift = self.motion.arm.jacobian(self.reading.q_rad, Tcp((*self.payload.cog_m, 0.0, 0.0, 0.0)))[2]
        return JointTorques(torques.torque_nm + weight * lift, torques.coulomb_scale)

    def _check_faults(self, reading: ArmReading) -> None:
        """Stop protectively after an infeasible command, or if the arm deviates from its path."""
        fault = self.motion.fault
        if fault is not None:
            self.motion.fault = None
            self.protective_stop(fault.code, fault.text)
        assumed = self.profile.assumptions
        away = np.abs(self._wanted - reading.q_rad)
        self._wanted = self.motion.q
        self._deviating = self._deviating + 1 if away.max() > assumed.deviation_rad else 0
        if self._deviating >= assumed.deviation_ticks:
            self._deviating = 0
            joint = int(away.argmax())
            text = f"position deviates from path: joint {joint} by {away[joint]:.3f} rad, allowed are "
            self.protective_stop("C153A0", f"{text}{assumed.deviation_rad:g} rad")
            self.motion.hold_at(reading.q_rad)
            self._wanted = self.motion.q

    def note_setpoint(self, q_rad: Sequence[float], t_s: float, lookahead_s: float, gain: float) -> None:
        """Record an executed servoj target."""
        self.setpoints_count += 1
        self.setpoints.append((self.ticks, tuple(q_rad), float(t_s), float(lookahead_s), float(gain)))

    def override(self, name: str, value: Any) -> None:
        """Report this value of a variable to clients from the next tick on, instead of the true one; None ends it."""
        if value is not None:
            self._overridden.setdefault(name, self.values[name])
            self.overrides[name] = value
        elif self.overrides.pop(name, None) is not None:
            self.values[name] = self._overridden.pop(name)

    # Stops.

    def protective_stop(self, code: str, text: str) -> None:
        """Stop protectively, with an error code of UR."""
        if self.safety.safety_mode != SafetyMode.PROTECTIVE_STOP:
            log.warning("%s: protective stop: %s: %s", self.name, code, text)
            self.stop(SafetyMode.PROTECTIVE_STOP, text, code)

    def stop(self, mode: int, text: str = "", code: str | None = None) -> None:
        """Raise a stop condition, and report it to clients of the primary interface.

        Args:
            mode: Any number that RTDE's `safety_mode` may have.
            text: Explanation.
            code: Error code of UR; None: the cause has none.

        Raises:
            OperationRefusedError: The mode stands for normal operation.
        """
        before = self.safety.safety_mode
        self.safety.stop(mode, text if code is None else f"{code}: {text}")
        if before != mode:
            code, level = code or "C0A0", _LEVELS.get(mode, messages.ReportLevel.VIOLATION)
            self.messages.append(messages.error_code_message(self.time_s, code, text, level=level))
            self.messages.append(messages.safety_mode_message(self.time_s, mode, code))
            self._reported_mode = self.safety.safety_mode

    def send_text(self, text: str) -> None:
        """Send a text message of a program to clients of the primary interface."""
        self.spend(len(text) // CHARACTERS_PER_STEP)
        self.messages.append(messages.text_message(self.time_s, text))

    def open_popup(
        self, title: str, text: str, *, warning: bool = False, error: bool = False, blocking: bool = False
    ) -> None:
        """Open a popup, and report it to clients of the primary interface with its style."""
        self.spend(len(text) // CHARACTERS_PER_STEP)
        self.popup = text
        self.messages.append(
            messages.popup_message(self.time_s, title, text, warning=warning, error=error, blocking=blocking)
        )

    def _script_failed(self, error: ScriptError) -> None:
        log.warning("%s: program stopped: %s", self.name, error)
        self.messages.append(messages.script_error_message(self.time_s, error))

    def _announce(self, title: str, text: str) -> None:
        self.messages.append(messages.key_message(self.time_s, title, text))

    def spend(self, steps: int) -> None:
        """Charge a costly function with so many statements of this control period.

        Raises:
            RecursionError: The control period has fewer left.
        """
        machine = self.program.running
        if machine is not None:
            machine.spend(steps)

    def use_external_sensor(self, enable: bool) -> None:
        """Take forces from the sensor that an RTDE client reports, or the arm's own again.

        Where a program has set no other watchdog, one pauses it if that client falls silent: UR's script manual.
        """
        self.external_sensor, name = enable, "external_force_torque"
        if enable and not self.watchdogs:
            writes, machine = self.registers.writes.get(name, 0), self.program.machine
            self._sensor_watchdog = Watchdog(name, SENSOR_S, "pause", writes, machine)
            self.watchdogs[name] = self._sensor_watchdog
        elif not enable and self.watchdogs.get(name) is self._sensor_watchdog:
            self.watchdogs.pop(name, None)

    def _watch(self) -> None:
        for name, watchdog in tuple(self.watchdogs.items()):
            if watchdog.machine is None or watchdog.machine is not self.program.machine:
                del self.watchdogs[name]  # it ends with the program that set it
                continue
            if watchdog.is_fed(self.registers, self.profile.assumptions.watchdog_counts_unchanged):
                continue
            watchdog.since_s += self.profile.tick_s
            if watchdog.since_s > watchdog.period_s and self.watchdog_acts:
                log.warning("%s: the watchdog on %s was not fed for %.3g s", self.name, name, watchdog.since_s)
                text = f"no client wrote {name} for {watchdog.since_s:.3g} s: {watchdog.action}"
                self._announce("RTDE_WATCHDOG", text)
                del self.watchdogs[name]
                if watchdog.action == "pause":
                    self.program.pause()
                else:
                    self.program.stop("its watchdog was not fed")

    # Measured and reported values.

    def zero_wrench(self) -> None:
        """Take the present force as zero."""
        self._wrench_zero = self._raw_wrench.copy()

    def _measure(self, reading: ArmReading) -> None:
        wrench = reading.wrench.copy()
        weight = (self.payload.mass_kg - self.gripper_kg) * GRAVITY_M_S2
        if weight:
            wrench[2] += weight
            _, rotation = flange_pose(reading.q_rad, self.dh)
            wrench[3:] += cross(rotation @ self.payload.cog_m, np.array([0.0, 0.0, weight]))
        if any(self.motion.tcp[:3]):
            tcp, flange = self.motion.tcp_pose(reading.q_rad), self.motion.flange_pose(reading.q_rad)
            lever = np.subtract(tcp[:3], flange[:3])
            wrench[3:] -= cross(lever, wrench[:3])
        self._raw_wrench = wrench
        self.wrench = wrench - self._wrench_zero
        if self.external_sensor and self.io.external_wrench is not None:
            self.wrench = np.array(self.io.external_wrench)
        self.history.append(tuple(reading.q_rad.tolist()))
        self.forces.append(tuple(self.wrench[:3].tolist()))

    def _publish(self, qdd: Array) -> None:
        """Update the values that are reported to clients."""
        values, program, safety = self._values, self.program, self.safety
        running = safety.robot_mode == RobotMode.RUNNING
        values.renew(self.reading, self.motion, qdd, self.wrench)
        values["timestamp"] = self.time_s
        values["actual_digital_input_bits"] = self.io.inputs
        values["actual_digital_output_bits"] = self.io.outputs
        values["standard_analog_output0"], values["standard_analog_output1"] = self.io.analog(0), self.io.analog(1)
        values["tool_output_voltage"] = self.io.tool_voltage
        values["analog_io_types"] = self.io.analog_types
        values["robot_mode"] = int(safety.robot_mode)
        values["joint_mode"] = _RUNNING if running else (int(_joint_mode(safety.robot_mode)),) * 6
        values["safety_mode"] = values["safety_status"] = int(safety.safety_mode)
        values["safety_status_bits"] = int(safety.safety_bits)
        values["robot_status_bits"] = int(self.robot_bits)
        values["runtime_state"] = int(program.state)
        values["speed_scaling"] = program.scaling
        values["target_speed_fraction"] = self.io.slider
        values["payload"] = self.payload.mass_kg
        values["payload_cog"] = self.payload.cog_m
        values["payload_inertia"] = self.payload.inertia_kg_m2
        if "tcp_offset" in values:
            values["tcp_offset"] = self.motion.tcp
        values.update(self.overrides)

    @property
    def robot_bits(self) -> RobotBits:
        """RTDE's `robot_status_bits`."""
        return _ROBOT_BITS[self.safety.robot_mode in _POWERED][self.program.state in _PLAYS]

    @property
    def steady(self) -> bool:
        """True if the arm has stood for half a second, and no motion was commanded."""
        return self._standing * self.profile.tick_s >= STEADY_S

    @property
    def _stands(self) -> bool:
        there = float(np.abs(self.motion.q - self.reading.q_rad).max()) < STEADY_RAD
        return not self.motion.moving and there and float(np.abs(self.reading.qd_rad_s).max()) < STEADY_RAD_S

    # Input from clients.

    def inputs(self, values: Mapping[str, Any]) -> None:
        """Apply the values of an RTDE input package that are no registers."""
        self.io.apply(values)

    def run_script(self, text: str, found: Program | ScriptError | None = None) -> None:
        """Run a program received on a script port. Local mode refuses it, as on a real controller.

        Args:
            text: Text of the program.
            found: Result of parsing it, if it has been parsed already.
        """
        if self.takes_scripts:
            self.program.load(text, found)
        else:
            self.refuse("a program", "the controller is in local mode")

    @property
    def takes_scripts(self) -> bool:
        """True unless the controller is in local mode."""
        return self.remote_control is not False or not self.profile.has_remote_control

    def refuse(self, request: str, reason: str) -> None:
        """Report a request on a script port that is refused."""
        log.warning("%s: %s is refused: %s", self.name, request, reason)
        self._announce("PROGRAM_REFUSED", reason)

    def play(self) -> None:
        """Start or resume the program.

        Raises:
            OperationRefusedError: The arm must not move, or there is no program.
        """
        if self.safety.demand is not Demand.NONE:
            raise OperationRefusedError("the arm is stopped or has no power")
        self.program.play()


def _joint_mode(mode: RobotMode) -> JointMode:
    return JointMode.POWER_OFF if mode < RobotMode.POWER_ON else JointMode.IDLE
