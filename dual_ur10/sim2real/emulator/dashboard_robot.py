"""What the dashboard server needs of the controller behind it."""

from __future__ import annotations

from typing import Final, Protocol

USER_ROLES: Final = ("programmer", "operator", "none", "locked", "restricted")
"""User roles of a CB3 (UR's article "Dashboard Server CB-Series")."""


class DashboardRobot(Protocol):
    """What the dashboard asks of a controller.

    Methods raise [OperationRefusedError][dual_ur10.errors.OperationRefusedError] where a controller would refuse.
    """

    @property
    def robot_mode(self) -> int:
        """RTDE's `robot_mode`."""
        ...

    @property
    def safety_mode(self) -> int:
        """RTDE's `safety_mode`."""
        ...

    @property
    def runtime_state(self) -> int:
        """RTDE's `runtime_state`."""
        ...

    @property
    def remote_control(self) -> bool:
        """Whether the controller is in remote control; asked only where the profile has it."""
        ...

    @property
    def loaded_program(self) -> str:
        """Path of the program that `play` starts, or ""."""
        ...

    @property
    def program_saved(self) -> bool:
        """Whether the loaded program is as on disk."""
        ...

    @property
    def operational_mode(self) -> str:
        """Either "NONE", "MANUAL" or "AUTOMATIC"."""
        ...

    @property
    def user_role(self) -> str:
        """One of `USER_ROLES` (CB3)."""
        ...

    def power_on(self) -> None:
        """Power the arm."""

    def power_off(self) -> None:
        """Take power from the arm."""

    def release_brakes(self) -> None:
        """Release the brakes, after powering the arm if it has no power."""

    def unlock_protective_stop(self) -> None:
        """End a protective stop. The text of a refusal is the answer."""

    def close_safety_popup(self) -> None:
        """Close the message about a stop."""

    def restart_safety(self) -> None:
        """Restart after a violation or a fault."""

    def play(self) -> None:
        """Start the loaded program, or let a paused one go on."""

    def pause(self) -> None:
        """Pause the program."""

    def stop(self) -> None:
        """Stop the program."""

    def load(self, name: str) -> None:
        """Load a program.

        Raises:
            UnknownNameError: There is no such program.
        """

    def load_installation(self, name: str) -> None:
        """Load an installation.

        Raises:
            UnknownNameError: There is no such installation.
        """

    def popup(self, text: str) -> None:
        """Show a message on the pendant."""

    def close_popup(self) -> None:
        """Close that message."""

    def add_to_log(self, text: str) -> None:
        """Write to the controller's log."""

    def shutdown(self) -> None:
        """Switch the controller off."""

    def set_operational_mode(self, mode: str) -> None:
        """Switch to "MANUAL" or "AUTOMATIC"; only the dashboard can then switch it again."""

    def clear_operational_mode(self) -> None:
        """Let the pendant switch the operational mode again."""

    def set_user_role(self, role: str) -> None:
        """Switch to one of `USER_ROLES` (CB3)."""
