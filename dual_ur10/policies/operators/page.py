"""Live page as an input device: its drag handles and buttons."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from dual_ur10.assets.visuals import cameras as cameras_of
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.guard import PORT
from dual_ur10.envs.rendering.live.live_page import LivePage
from dual_ur10.errors import DeviceUnpluggedError, SettingsError, UnknownNameError
from dual_ur10.policies.operators.device import Reading
from ur_core.processes.system import LOCAL, System

CAMERAS: Final = "front"
"""Camera that a page shows by default."""

NO_CAMERAS: Final = "none"


class PageDevice:
    """Drag handles at both tools, as a `dual_ur10.policies.operators.device.Device`.

    A handle that is not dragged, a page that is closed or lost, and a page's process that stalls release the clutch.

    Args:
        page: The page, which is ready.

    Attributes:
        name: Name in messages.
        hands: Both.
        page: As above.
    """

    hands = 2

    def __init__(self, page: LivePage) -> None:
        self.name = "the live page"
        self.page = page

    def begin(self) -> None:
        """See `Device`. Presses are for the program, too, between episodes: none is forgotten."""

    def read(self) -> Reading:
        """Return the handles and the buttons.

        Raises:
            DeviceUnpluggedError: The page's process has ended, or hangs while it commands controllers.
        """
        if lost := self.page.lost:
            raise DeviceUnpluggedError(f"{self.name} is gone: {lost}. Start the program again")
        handles = self.page.handles()
        return Reading(
            poses=handles.poses.copy(),
            clutch=np.array(handles.clutch, dtype=bool),
            gripper=handles.gripper.copy(),
            triggers=False,
            buttons=frozenset(self.page.pressed()),
        )

    def close(self) -> None:
        """End the page. May be called twice."""
        self.page.close()


def open_page(
    setup: EnvSetup,
    buttons: Sequence[str] = (),
    *,
    port: int = PORT,
    cameras: str = CAMERAS,
    handles: bool = True,
    policies: Sequence[str] = (),
    unattended: bool = False,
    system: System = LOCAL,
) -> LivePage:
    """Start the page of an environment. `LivePage.wait_until_ready` waits for it.

    Args:
        setup: The environment.
        buttons: Names in `dual_ur10.envs.rendering.live.buttons.BUTTONS` of what the program acts on.
        port: Port of the loopback interface; 0: any free one.
        cameras: Names of cameras of the scene whose images are shown, with "," or "/" between them; or "none".
        handles: Drag handles at both tools, and buttons for the grippers.
        policies: Names of the policies between which the page switches.
        unattended: Arms of controllers go on while no page is open.
        system: Clock and processes.

    Raises:
        UnknownNameError: There is no such camera.
        MissingExtraError: viser is not installed.
    """
    equipment, scene = setup.config.equipment, setup.config.scene
    known = cameras_of(scene)
    names = () if cameras == NO_CAMERAS else _separated(cameras, known)
    for name in names:
        if name not in known:
            raise UnknownNameError("camera", name, [*known, NO_CAMERAS])
    speeds = tuple(setup.limits.speed_rad_s)
    about = About(
        title=setup.env_id,
        scene=scene,
        speed_rad_s=(speeds, speeds),
        buttons=tuple(buttons),
        handles=handles,
        grippers=handles and equipment.grippers and not equipment.welded,
        cameras=names,
        policies=tuple(policies),
        controllers=bool(setup.config.controllers),
        unattended=unattended,
    )
    return LivePage(about, port=port, system=system)


def _separated(text: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return names with "," or "/" between them. Known ones may have a "/" themselves."""
    whole = "|".join(map(re.escape, known))
    return tuple(filter(None, map(str.strip, re.findall(rf"\s*(?:{whole})(?=\s*[,/]|\s*$)|[^,/]+", text))))


def page_device(
    setup: EnvSetup,
    port: int = PORT,
    cameras: str = CAMERAS,
    unattended: bool = False,
    *,
    acts_on: Sequence[str] = (),
) -> PageDevice:
    """Start a page in a browser with a handle at each tool, for one hand or two, and wait until it serves.

    On controllers it has the button that stops both arms.

    Args:
        setup: The environment.
        port: As for `open_page`.
        cameras: As for `open_page`.
        unattended: As for `open_page`.
        acts_on: Names of further buttons.

    Raises:
        SettingsError: The port is busy or not allowed.
        RenderError: The page did not start.
        DualUR10Error: As for `open_page`.
    """
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port < 2**16:
        raise SettingsError(f"port is {port!r}: it must be a whole number from 0 to 65535")
    if not isinstance(unattended, bool):
        raise SettingsError(f"unattended is {unattended!r}: it must be true or false")
    shown = (*(("stop",) if setup.config.controllers else ()), *acts_on)
    page = open_page(setup, shown, port=port, cameras=str(cameras), unattended=unattended)
    page.wait_until_ready()
    return PageDevice(page)
