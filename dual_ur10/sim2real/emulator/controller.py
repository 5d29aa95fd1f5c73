"""One emulated UR controller: the work of one control period."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import OperationRefusedError, ScriptError
from dual_ur10.kinematics.forward import elbow_and_flange_position, flange_pose
from dual_ur10.kinematics.rotations import cross
from dual_ur10.kinematics.ur10 import DHParameters
from dual_ur10.sim2real.emulator.inputs_outputs import InputsOutputs
from dual_ur10.sim2real.emulator.motion import Motion
from dual_ur10.sim2real.emulator.profile import ControllerProfile
from dual_ur10.sim2real.emulator.program_runner import ProgramRunner
from dual_ur10.sim2real.emulator.received import Received
from dual_ur10.sim2real.emulator.registers import Registers, Watchdog
from dual_ur10.sim2real.emulator.rtde_variables import zero_values
from dual_ur10.sim2real.emulator.safety import Demand, Safety
from dual_ur10.sim2real.emulator.script import Builtins, Program
from dual_ur10.sim2real.protocol import primary_messages as messages
from dual_ur10.sim2real.protocol.modes import JointMode, RobotBits, RobotMode, RuntimeState, SafetyMode
from dual_ur10.types import Array

log = logging.getLogger(__name__)

GRAVITY_M_S2: Final = 9.81

# UR publishes no torque constants. These give plausible currents for the simulated torques.
_NM_PER_A: Final = np.array([13.0, 13.0, 10.0, 9.0, 9.0, 9.0])

_HISTORY: Final = 1000  # control periods of joint positions kept for programs
_SETPOINTS: Final = 50_000  # executed servoj targets kept
_MESSAGES: Final = 256

STEADY_RAD: Final = 0.01
STEADY_RAD_S: Final = 0.001
REDUCED_SPEED: Final = 0.5  # ratio of the speed in reduced mode; a real one depends on the safety configuration


class ArmReading(NamedTuple):
    """Measurements of one arm.

    Attributes:
        q_rad: (6,) joint positions.
        qd_rad_s: (6,) joint speeds.
        torque_nm: (6,) motor torques of the joints.
        wrench: (6,) force and torque on the flange, N and N·m, along the axes of the arm's `base`, without the
            gripper's own weight; zero where nothing measures it.
        gripper_m: Gripper width; None without a gripper.
    """

    q_rad: Array
    qd_rad_s: Array
    torque_nm: Array
    wrench: Array
    gripper_m: float | None


class Setpoint(NamedTuple):
    """One executed servoj target."""

    tick: int
    q_rad: tuple[float, ...]
    t_s: float
    lookahead_s: float
    gain: float


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
    ) -> None:
        self.name, self.profile = name, profile
        self.dh = dh
        self.ticks = 0
        self.boot_s = boot_s
        self.registers = Registers()
        self.received = Received(self.registers)
        self.io = InputsOutputs()
        self.safety = Safety(profile.assumptions, powered=powered)
        self.motion = Motion(
            profile.tick_s, substeps, q_rad, dh=dh, lookahead_scale=lookahead_scale, assumptions=profile.assumptions
        )
        self.payload = Payload(gripper_kg)
        self.gripper_kg = gripper_kg
        self.values: dict[str, Any] = zero_values(profile)
        self.overrides: dict[str, Any] = {}
        self._overridden: dict[str, Any] = {}
        self.remote_control = True
        self.history: deque[tuple[float, ...]] = deque(maxlen=_HISTORY)
        self.setpoints: deque[Setpoint] = deque(maxlen=_SETPOINTS)
        self.setpoints_count = 0
        self.external_sensor = False
        self.popup = ""
        self.messages: deque[bytes] = deque(maxlen=_MESSAGES)
        self.watchdog: Watchdog | None = None
        self.watchdog_acts = True
        self.wrench: Array = np.zeros(6)
        self._wanted: Array = np.array(q_rad, dtype=float)
        self._deviating = 0
        self._ran = False
        self._raw_wrench: Array = np.zeros(6)
        self._wrench_zero: Array = np.zeros(6)
        self.program = ProgramRunner(profile, self.motion, builtins(self), self._script_failed)
        self.reading = ArmReading(np.array(q_rad, dtype=float), np.zeros(6), np.zeros(6), np.zeros(6), None)
        self._elbow: Array = elbow_and_flange_position(self.reading.q_rad)[0]
        self._constant_values()
        self._publish(np.zeros(6))

    @property
    def time_s(self) -> float:
        """Time since the controller was started: RTDE's `timestamp`."""
        return self.boot_s + self.ticks * self.profile.tick_s

    def tick(self, reading: ArmReading) -> Array:
        """Begin one control period: measure, run the program, and plan the motion.

        Returns:
            (substeps, 3, 6): the motion, as `EmulatedWorld.advance` takes it.
        """
        self.ticks += 1
        self.reading = reading
        self._measure(reading)
        self.safety.tick(self.profile.tick_s, at_rest=not self.motion.moving or self.program.scaling == 0.0)
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
        self._check_faults(reading)
        self._publish((self.motion.qd - before) / self.profile.tick_s)
        return plan

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
        self.setpoints.append(Setpoint(self.ticks, tuple(q_rad), float(t_s), float(lookahead_s), float(gain)))

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
        if self.safety.safety_mode == SafetyMode.PROTECTIVE_STOP:
            return
        log.warning("%s: protective stop: %s: %s", self.name, code, text)
        self.safety.stop(SafetyMode.PROTECTIVE_STOP, f"{code}: {text}")
        self.messages.append(messages.error_code_message(self.time_s, code, text))
        self.messages.append(messages.safety_mode_message(self.time_s, SafetyMode.PROTECTIVE_STOP, code))

    def send_text(self, text: str) -> None:
        """Send a text message of a program to clients of the primary interface."""
        self.messages.append(messages.text_message(self.time_s, text))

    def open_popup(self, title: str, text: str) -> None:
        """Open a popup."""
        self.popup = text
        self.messages.append(messages.popup_message(self.time_s, title, text))

    def _script_failed(self, error: ScriptError) -> None:
        log.warning("%s: program stopped: %s", self.name, error)
        self.messages.append(messages.script_error_message(self.time_s, error))

    def spend(self, steps: int) -> None:
        """Charge a costly function with so many statements of this control period.

        Raises:
            RecursionError: The control period has fewer left.
        """
        machine = self.program.machine
        if machine is not None and machine.thread is not None:
            machine.spend(steps)

    def _watch(self) -> None:
        watchdog = self.watchdog
        if watchdog is None:
            return
        if self.program.machine is None or self.program.machine is not watchdog.machine:
            self.watchdog = None  # it ends with the program that set it
            return
        if watchdog.is_fed(self.registers, self.profile.assumptions.watchdog_counts_unchanged):
            return
        watchdog.since_s += self.profile.tick_s
        if watchdog.since_s > watchdog.period_s and self.watchdog_acts:
            log.warning("%s: the watchdog on %s was not fed for %.3g s", self.name, watchdog.name, watchdog.since_s)
            text = f"no client wrote {watchdog.name} for {watchdog.since_s:.3g} s: {watchdog.action}"
            self.messages.append(messages.key_message(self.time_s, "RTDE_WATCHDOG", text))
            self.watchdog = None
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

    def _constant_values(self) -> None:
        values = self.values
        values.update(
            joint_temperatures=(30.0,) * 6,
            actual_main_voltage=48.0,
            actual_robot_voltage=48.0,
            actual_joint_voltage=(48.0,) * 6,
            actual_tool_accelerometer=(0.0, 0.0, GRAVITY_M_S2),
            tool_temperature=30.0,
            tool_mode=int(JointMode.RUNNING),
            actual_execution_time=0.0,
        )

    def _publish(self, qdd: Array) -> None:
        """Update the values that are reported to clients."""
        values, motion, reading, program, safety = self.values, self.motion, self.reading, self.program, self.safety
        running = safety.robot_mode == RobotMode.RUNNING
        current = reading.torque_nm / _NM_PER_A
        values["timestamp"] = self.time_s
        values["target_q"] = tuple(motion.q.tolist())
        values["target_qd"] = tuple(motion.qd.tolist())
        values["target_qdd"] = tuple(qdd.tolist())
        values["target_moment"] = tuple(reading.torque_nm.tolist())
        values["target_current"] = values["actual_current"] = values["joint_control_output"] = tuple(current.tolist())
        values["actual_robot_current"] = 0.5 + 0.1 * float(np.abs(current).sum())
        values["actual_q"] = tuple(reading.q_rad.tolist())
        values["actual_qd"] = tuple(reading.qd_rad_s.tolist())
        q, qd = np.stack([reading.q_rad, motion.q]), np.stack([reading.qd_rad_s, motion.qd])
        poses, speeds = motion.tcp_poses_and_speeds(q, qd)
        values["actual_TCP_pose"], values["target_TCP_pose"] = poses
        values["actual_TCP_speed"], values["target_TCP_speed"] = speeds
        elbow = elbow_and_flange_position(reading.q_rad)[0]
        values["elbow_velocity"] = tuple(((elbow - self._elbow) / self.profile.tick_s).tolist())
        values["elbow_position"], self._elbow = tuple(elbow.tolist()), elbow
        values["actual_TCP_force"] = tuple(self.wrench.tolist())
        if "tcp_force_scalar" in values:
            values["tcp_force_scalar"] = float(np.linalg.norm(self.wrench[:3]))
        if "ft_raw_wrench" in values:
            values["ft_raw_wrench"] = tuple(reading.wrench.tolist())
        values["actual_digital_input_bits"] = self.io.inputs
        values["actual_digital_output_bits"] = self.io.outputs
        values["standard_analog_output0"], values["standard_analog_output1"] = self.io.analog(0), self.io.analog(1)
        values["tool_output_voltage"] = self.io.tool_voltage
        values["analog_io_types"] = self.io.analog_types
        values["robot_mode"] = int(safety.robot_mode)
        values["joint_mode"] = (int(JointMode.RUNNING if running else _joint_mode(safety.robot_mode)),) * 6
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
            values["tcp_offset"] = tuple(motion.tcp)
        values.update(self.overrides)

    @property
    def robot_bits(self) -> RobotBits:
        """RTDE's `robot_status_bits`."""
        bits = RobotBits(0)
        if self.safety.robot_mode in (RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.RUNNING):
            bits |= RobotBits.POWER_ON
        if self.program.state in (RuntimeState.PLAYING, RuntimeState.RESUMING, RuntimeState.PAUSING):
            bits |= RobotBits.PROGRAM_RUNNING
        return bits

    @property
    def steady(self) -> bool:
        """True if the arm stands and no motion is commanded."""
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
        if self.profile.has_remote_control and not self.remote_control:
            log.warning("%s: a program is refused: the controller is in local mode", self.name)
            self.messages.append(
                messages.key_message(self.time_s, "PROGRAM_REFUSED", "the controller is in local mode")
            )
            return
        self.program.load(text, found)

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
