"""Digital and analog inputs and outputs of one controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

STANDARD, CONFIGURABLE, TOOL = 0, 8, 16
"""First bit of each group in RTDE's `actual_digital_output_bits` and `actual_digital_input_bits`."""

_GROUPS: Final = {
    "standard_digital_output": (STANDARD, 8),
    "configurable_digital_output": (CONFIGURABLE, 8),
    "tool_digital_output": (TOOL, 2),
}

_TOOL_VOLTS: Final = (0, 12, 24)
_VOLTS: Final = 10.0  # full scale of an analog output as a voltage; UR's user manual
_LEAST_A, _SPAN_A = 0.004, 0.016  # and as a current


class InputsOutputs:
    """State of all inputs and outputs.

    Attributes:
        inputs: Bits of the digital inputs, in RTDE's order.
        outputs: Bits of the digital outputs.
        slider: Position of the speed slider, 0 to 1.
        tool_voltage: Supply of the tool, V.
        external_wrench: Wrench that a client reports from an external sensor, N and N·m, or None.
    """

    def __init__(self) -> None:
        self.inputs = 0
        self.outputs = 0
        self.slider = 1.0
        self.external_wrench: tuple[float, ...] | None = None
        self.tool_voltage = 24
        self._analog = [0.0, 0.0]  # fraction of full scale
        self._voltage = [False, False]

    def apply(self, values: Mapping[str, Any]) -> None:
        """Apply the values of an RTDE input package, as far as their masks select them."""
        for name, (first, count) in _GROUPS.items():
            mask = int(values.get(f"{name}_mask", 0)) & ((1 << count) - 1)
            self.outputs = self.outputs & ~(mask << first) | (int(values.get(name, 0)) & mask) << first
        mask = int(values.get("standard_analog_output_mask", 0))
        for index in range(2):
            if mask >> index & 1:
                kind = int(values.get("standard_analog_output_type", 0))
                self.set_analog(index, float(values.get(f"standard_analog_output_{index}", 0.0)), kind >> index & 1 > 0)
        if int(values.get("speed_slider_mask", 0)) and "speed_slider_fraction" in values:
            self.set_slider(float(values["speed_slider_fraction"]))
        if "external_force_torque" in values:
            self.external_wrench = tuple(values["external_force_torque"])

    def set_output(self, bit: int, value: bool) -> None:
        """Set one digital output, 0 to 17.

        Raises:
            ValueError: There is no such output.
        """
        if not 0 <= bit < TOOL + 2:
            raise ValueError(f"there is no digital output {bit}: they are 0 to {TOOL + 1}")
        self.outputs = self.outputs | 1 << bit if value else self.outputs & ~(1 << bit)

    def set_input(self, bit: int, value: bool) -> None:
        """Set one digital input, as a wire would.

        Raises:
            ValueError: There is no such input.
        """
        if not 0 <= bit < TOOL + 2:
            raise ValueError(f"there is no digital input {bit}: they are 0 to {TOOL + 1}")
        self.inputs = self.inputs | 1 << bit if value else self.inputs & ~(1 << bit)

    def set_analog(self, index: int, fraction: float, voltage: bool | None = None) -> None:
        """Set an analog output to a fraction of its range, as a voltage or a current; None keeps the kind.

        Raises:
            ValueError: There is no such output.
        """
        if index not in (0, 1):
            raise ValueError(f"there is no analog output {index}: they are 0 and 1")
        self._analog[index] = min(1.0, max(0.0, fraction)) if fraction == fraction else 0.0
        if voltage is not None:
            self._voltage[index] = voltage

    def set_tool_voltage(self, voltage: int) -> None:
        """Set the supply of the tool.

        Raises:
            ValueError: Controllers do not supply this voltage.
        """
        if voltage not in _TOOL_VOLTS:
            raise ValueError(f"the tool cannot be supplied with {voltage!r} V: allowed are {_TOOL_VOLTS}")
        self.tool_voltage = int(voltage)

    def set_slider(self, fraction: float) -> None:
        """Move the speed slider. Values are clipped to its range; NaN is ignored."""
        if fraction == fraction:
            self.slider = min(1.0, max(0.0, fraction))

    def analog(self, index: int) -> float:
        """Return an analog output, V or A."""
        fraction = self._analog[index]
        return fraction * _VOLTS if self._voltage[index] else _LEAST_A + fraction * _SPAN_A

    @property
    def analog_types(self) -> int:
        """RTDE's `analog_io_types`: bits 2 and 3 are the outputs, 1 is a voltage."""
        return self._voltage[0] << 2 | self._voltage[1] << 3
