"""Pytest fixture of one emulated controller, for tests of your own project.

In a `conftest.py` at the top of the tests:

    pytest_plugins = ["ur_emulator.testing"]

and in a test:

    @pytest.mark.ur_controller(robot="ur3e", plant="nominal")
    def test_my_driver(ur_controller):
        driver = MyDriver(ur_controller.host)
        ur_controller.ask("stop", mode=3)  # a protective stop
        ur_controller.wait_for("safety_mode", 3)

Without a marker the arm is a UR5e. For a controller that several tests share, define your own fixture with
`EmulatedController`.
"""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

from ur_core.errors import SettingsError
from ur_emulator.emulated_controller import EmulatedController

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pytest

__all__ = ["EmulatedController", "options_of"]


def __dir__() -> list[str]:
    # pytest finds hooks and fixtures by it.
    return sorted({*__all__, *({"pytest_configure", "ur_controller"} & globals().keys())})


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line("markers", "ur_controller(**options): options of the controller: robot, plant, seed, ...")


def options_of(request: pytest.FixtureRequest, marked: str, example: str) -> dict[str, Any]:
    """Return options for a test, from its markers, the nearest last, and from its parameter.

    Args:
        request: Request of the fixture.
        marked: Name of the marker.
        example: Example of an option, for messages.

    Raises:
        SettingsError: A marker has values without names, or the parameter is no mapping.
    """
    options: dict[str, Any] = {}
    for marker in reversed(list(request.node.iter_markers(marked))):
        if marker.args:
            raise SettingsError(f"the marker {marked} has {marker.args!r}: name each option, as in {example}")
        options.update(marker.kwargs)
    given = getattr(request, "param", None) or {}
    if not isinstance(given, dict):
        raise SettingsError(f"the parameter of {marked} is {given!r}: it must be a dict of options")
    return {**options, **given}


if importlib.util.find_spec("pytest") is not None:
    import pytest

    @pytest.fixture
    def ur_controller(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[EmulatedController]:
        """Run one emulated controller for one test, in real time, at a free loopback address.

        Its options come from `@pytest.mark.ur_controller(robot="ur3e", plant="nominal")`, or from a parameter:
        `@pytest.mark.parametrize("ur_controller", [{"robot": "ur10e"}], indirect=True)`.
        """
        options = options_of(request, "ur_controller", "robot='ur3e'")
        with EmulatedController(**{"log": tmp_path / "ur_controller.log", **options}) as controller:
            yield controller
