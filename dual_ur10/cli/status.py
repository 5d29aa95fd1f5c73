"""The command `status`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import console
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from ur_core.kinematics.ur10 import ARMS
from ur_core.processes.system import LOCAL

_REFRESH_HZ: Final = 5.0
_FIRST_S: Final = 5.0
_NONE: Final = "—"
_JOINTS: Final = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")
_GROUPS: Final = ((0, 8), (8, 8), (16, 2))  # bits of digital inputs and outputs: standard, configurable, tool


def status(
    cell: Annotated[Path, typer.Option("--cell", metavar="FILE", help="A cell file.")],
    once: Annotated[bool, typer.Option("--once", help="Print the state once. Exit code 1 if an arm is lost.")] = False,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after this time.")] = None,
) -> None:
    """Show both arms live: modes, power, currents, temperatures, joints, inputs and outputs. Read-only."""
    from dual_ur10.cli.status_view import StatusView

    file = load_cell_file(cell)
    clock = LOCAL.clock
    arms = [StatusView(name, arm, system=LOCAL) for name, arm in zip(ARMS, file.arms, strict=True)]
    try:
        end_s = clock.now_s() + _FIRST_S
        for arm in arms:
            arm.wait(end_s - clock.now_s())
        if once:
            console.print(picture(arms))
        else:
            _show(arms, math.inf if seconds is None else clock.now_s() + seconds)
    except KeyboardInterrupt:
        console.print("ended")
    finally:
        for arm in arms:
            arm.close()
    if any(arm.dead for arm in arms):
        raise typer.Exit(1)


def _show(arms: Sequence[Any], end_s: float) -> None:
    with Live(picture(arms), console=console, auto_refresh=False, transient=False) as live:
        while LOCAL.clock.now_s() < end_s:
            LOCAL.clock.sleep(1.0 / _REFRESH_HZ)
            live.update(picture(arms), refresh=True)


def picture(arms: Sequence[Any]) -> RenderableType:
    """Return the tables of both arms.

    Args:
        arms: The left and the right `StatusView`.
    """
    table = Table(header_style="bold")
    table.add_column("")
    for arm in arms:
        table.add_column(f"{arm.name} [dim]{arm.arm.host}[/]", overflow="fold", min_width=26)
    if any(arm.dead for arm in arms):
        table.add_row("lost", *(f"[bold red]{escape(arm.dead)}[/]" if arm.dead else "" for arm in arms))
    for label, text in _ROWS:
        cells = [_NONE if arm.status is None else text(arm) for arm in arms]
        # Values of a lost arm are old, and must look old.
        table.add_row(label, *(f"[dim]{each}[/]" if arm.dead else each for arm, each in zip(arms, cells, strict=True)))
    table.add_row("program", *map(_program, arms))
    table.add_row("gripper", *map(_gripper, arms))
    return Group(table, _joints(arms))


def _joints(arms: Sequence[Any]) -> Table:
    table = Table(header_style="bold")
    table.add_column("joint")
    for arm in arms:
        for header in (f"{arm.name} rad", "A", "°C", "V"):
            table.add_column(header, justify="right")
    for joint, name in enumerate(_JOINTS):
        row = []
        for arm in arms:
            known = arm.status
            if known is None:
                row += [_NONE] * 4
                continue
            cells = [
                _numbers([known.q_rad[joint]], 4),
                _numbers([known.current_a[joint]], 2),
                _numbers([known.temperature_c[joint]], 1),
                _numbers([known.joint_voltage_v[joint]], 1),
            ]
            row += [f"[dim]{each}[/]" for each in cells] if arm.dead else cells
        table.add_row(name, *row)
    return table


def _mode(arm: Any) -> str:
    from ur_core.links.arm_status import mode_name
    from ur_core.protocol.modes import RobotMode

    mode = arm.status.robot_mode
    return _coloured(mode_name(RobotMode, mode), mode == RobotMode.RUNNING)


def _safety(arm: Any) -> str:
    from ur_core.links.arm_status import mode_name
    from ur_core.protocol.modes import SafetyMode

    mode = arm.status.safety_mode
    return _coloured(mode_name(SafetyMode, mode), mode == SafetyMode.NORMAL)


def _may_move(arm: Any) -> str:
    from ur_core.links.arm_status import stop_reason

    reason = stop_reason(arm.status, playing=False)
    return _coloured(reason or "yes", reason is None)


def _power(arm: Any) -> str:
    from ur_core.protocol.modes import RobotBits

    known = arm.status
    on = bool(known.robot_bits & RobotBits.POWER_ON)
    volts = f"{known.main_voltage_v:.1f} V, arm {known.robot_voltage_v:.1f} V {known.robot_current_a:.2f} A"
    return f"{_coloured('on' if on else 'off', on)}, {volts}"


def _runs(arm: Any) -> str:
    from ur_core.links.arm_status import mode_name
    from ur_core.protocol.modes import RuntimeState

    return escape(mode_name(RuntimeState, arm.status.runtime_state))


def _slider(arm: Any) -> str:
    from dual_ur10.sim2real.control.time_scaling import FULL

    known = arm.status
    at = _coloured(f"{100 * known.slider:.0f} %", known.slider >= FULL)
    return f"{at}, scaling {100 * known.speed_scaling:.0f} %"


def _pose(arm: Any) -> str:
    return f"{_numbers(arm.status.tcp_pose[:3], 4)} m\n{_numbers(arm.status.tcp_pose[3:], 4)} rad"


def _force(arm: Any) -> str:
    return f"{_numbers(arm.status.tcp_force[:3], 1)} N\n{_numbers(arm.status.tcp_force[3:], 2)} N·m"


def _payload(arm: Any) -> str:
    kg = arm.status.payload_kg
    return _NONE if kg is None else f"{kg:.3f} kg"


def _bits(name: str) -> Callable[[Any], str]:
    def text(arm: Any) -> str:
        bits = getattr(arm.status, name)
        return " ".join(
            "".join(str(bits >> bit & 1) for bit in range(first, first + count)) for first, count in _GROUPS
        )

    return text


def _analog(arm: Any) -> str:
    known = arm.status
    outputs = [arm.values.get(f"standard_analog_output{number}") for number in range(2)]
    output = _NONE if None in outputs else _numbers(outputs, 3)
    return f"in {_numbers((known.analog_input0, known.analog_input1), 3)}, out {output}"


def _program(arm: Any) -> str:
    if arm.program_fault:
        return f"[red]{escape(arm.program_fault)}[/]"
    return escape(arm.program or _NONE)


def _gripper(arm: Any) -> str:
    if arm.gripper_fault:
        return f"[red]{escape(arm.gripper_fault)}[/]"
    if arm.gripper is None:
        return f"{arm.arm.gripper.kind}"
    opening_m, fault, holding = arm.gripper
    text = _NONE if opening_m is None else f"{1e3 * opening_m:.1f} mm{', holding' if holding else ''}"
    return f"{text}\n[red]{escape(fault)}[/]" if fault else text


_ROWS: Final[tuple[tuple[str, Callable[[Any], str]], ...]] = (
    ("software", lambda arm: escape(arm.version)),
    ("robot mode", _mode),
    ("safety mode", _safety),
    ("could move", _may_move),
    ("power", _power),
    ("program state", _runs),
    ("speed slider", _slider),
    ("TCP", _pose),
    ("force at it", _force),
    ("payload", _payload),
    ("inputs 0 … 17", _bits("digital_inputs")),
    ("outputs 0 … 17", _bits("digital_outputs")),
    ("analog", _analog),
)


def _coloured(text: str, fine: bool) -> str:
    return f"[{'green' if fine else 'bold red'}]{escape(text)}[/]"


def _numbers(values: Sequence[Any], digits: int) -> str:
    return " ".join(f"{round(float(each), digits) + 0.0:.{digits}f}" for each in values)
