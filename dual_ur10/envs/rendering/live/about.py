"""Content of a live page, as the program sets it."""

from __future__ import annotations

import dataclasses

from dual_ur10.assets.settings import SceneSettings


@dataclasses.dataclass(frozen=True)
class About:
    """Content of a page, as the program sets it at the start.

    Attributes:
        title: Title of the panel.
        scene: Scene of the cell.
        speed_rad_s: (2, 6) speed limits of the joints.
        buttons: Names of the buttons shown, of `BUTTONS`; without any, and without handles, the page only watches.
        handles: Drag handles at both tools.
        grippers: Buttons for both grippers.
        cameras: Cameras whose images are shown.
        policies: Names of the policies between which the page switches, at most as many as `POLICIES`.
        controllers: The arms are those of two controllers, and not of a simulation.
        unattended: These arms go on while no page is open.
    """

    title: str
    scene: SceneSettings
    speed_rad_s: tuple[tuple[float, ...], tuple[float, ...]]
    buttons: tuple[str, ...] = ()
    handles: bool = False
    grippers: bool = False
    cameras: tuple[str, ...] = ()
    policies: tuple[str, ...] = ()
    controllers: bool = False
    unattended: bool = False

    @property
    def commands(self) -> bool:
        """True if a page may command."""
        return bool(self.buttons) or self.handles

    @property
    def attended(self) -> bool:
        """True if arms of controllers move only while somebody can press a button of the page."""
        return self.commands and self.controllers and not self.unattended
