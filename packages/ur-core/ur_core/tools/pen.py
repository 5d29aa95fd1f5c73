"""Drawing of visual parts: boxes, rods and plates without mass or contacts."""

from __future__ import annotations

from typing import Any

import numpy as np


class Pen:
    """Adds visual parts to one body, y mirrored where `sign` is -1.

    Args:
        arm: `MjSpec` of the arm; materials are named as in it.
        body: Name of the body.
        sign: -1 to mirror.
    """

    def __init__(self, arm: Any, body: str, sign: int = 1) -> None:
        self._body, self._style, self._sign = arm.body(body), arm.find_default("visual"), sign

    def box(self, low: tuple[float, ...], high: tuple[float, ...], material: str) -> None:
        """Box between two corners."""
        middle, half = np.add(low, high) / 2, np.subtract(high, low) / 2
        self._add("box", pos=middle * (1, self._sign, 1), size=half, material=material)

    def rod(self, a: tuple[float, ...], b: tuple[float, ...], radius: float, material: str, kind: str) -> None:
        """Cylinder or capsule between two points."""
        ends = np.array([a, b]) * (1, self._sign, 1)
        self._add(kind, fromto=ends.ravel(), size=(radius, 0, 0), material=material)

    def disc(self, y: float, low: float, high: float, radius: float, material: str, x: float = 0.0) -> None:
        """Cylinder along z."""
        self.rod((x, y, low), (x, y, high), radius, material, "cylinder")

    def oval(self, low: float, high: float, half_y: float, radius: float, material: str) -> None:
        """Plate with round ends at y = ±half_y."""
        self.box((-radius, -half_y, low), (radius, half_y, high), material)
        for y in (-half_y, half_y):
            self.disc(y, low, high, radius, material)

    def _add(self, kind: str, **attributes: Any) -> None:
        import mujoco

        self._body.add_geom(self._style, type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), **attributes)
