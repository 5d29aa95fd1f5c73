"""What of the grippers is only looked at, and the cameras on their palms."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from dual_ur10.assets.gripper import FINGERTIP_M, PAD_LENGTH_M, PAD_THICK_M, PAD_WIDTH_M, PALM_LENGTH_M, TCP_M
from dual_ur10.kinematics.ur10 import ARMS

_MATERIALS: Final = {
    "shell": ((0.21, 0.22, 0.24, 1), 0.5, 0.5),
    "link": ((0.46, 0.48, 0.51, 1), 0.6, 0.6),
    "tip": ((0.32, 0.33, 0.36, 1), 0.4, 0.5),
    "steel": ((0.70, 0.72, 0.75, 1), 0.8, 0.8),
    "light": ((0.25, 0.65, 0.95, 1), 0.2, 0.2),
    "groove": ((0.20, 0.20, 0.22, 1), 0.1, 0.1),
    "glass": ((0.05, 0.07, 0.14, 1), 0.9, 0.9),
}  # colour, specular, shininess

_LENS: Final = (-0.0445, 0.0, 0.078)
_LOOKS_AT: Final = (0.0, 0.0, 0.20)


def draw_grippers(root: Any) -> None:
    """Draw both grippers of a cell's tree, and put a camera `wrist` on each."""
    for arm in ARMS:
        palm = root.find("body", f"{arm}/gripper")
        for name, (rgba, specular, shininess) in _MATERIALS.items():
            material = palm.root.asset.add("material", name=name, rgba=rgba, specular=specular, shininess=shininess)
            if name == "light":
                material.emission = 0.5
        _draw_palm(palm)
        _draw_camera(palm)
        for i, sign in ((1, 1), (2, -1)):
            _draw_finger(root.find("body", f"{arm}/finger_{i}"), sign)


class _Pen:
    """Draws parts of one body, y mirrored where `sign` is -1."""

    def __init__(self, body: Any, sign: int = 1) -> None:
        self._body, self._sign = body, sign
        self._look = body.root.find("default", "visual")

    def box(self, low: tuple[float, ...], high: tuple[float, ...], material: str) -> None:
        """Box between two corners."""
        middle, half = np.add(low, high) / 2, np.subtract(high, low) / 2
        self._add("box", pos=middle * (1, self._sign, 1), size=half, material=material)

    def rod(self, a: tuple[float, ...], b: tuple[float, ...], radius: float, material: str, kind: str) -> None:
        """Cylinder or capsule between two points."""
        ends = np.array([a, b]) * (1, self._sign, 1)
        self._add(kind, fromto=ends.ravel(), size=(radius,), material=material)

    def disc(self, y: float, low: float, high: float, radius: float, material: str, x: float = 0.0) -> None:
        """Cylinder along z."""
        self.rod((x, y, low), (x, y, high), radius, material, "cylinder")

    def oval(self, low: float, high: float, half_y: float, radius: float, material: str) -> None:
        """Plate with round ends at y = ±half_y."""
        self.box((-radius, -half_y, low), (radius, half_y, high), material)
        for y in (-half_y, half_y):
            self.disc(y, low, high, radius, material)

    def _add(self, kind: str, **attributes: Any) -> None:
        self._body.add("geom", dclass=self._look, type=kind, **attributes)


def _draw_palm(palm: Any) -> None:
    pen = _Pen(palm)
    pen.disc(0, 0.0, 0.0125, 0.0375, "steel")  # coupling
    pen.disc(0, 0.0125, 0.014, 0.0350, "rubber")
    pen.disc(0, 0.014, 0.044, 0.0365, "shell")
    pen.disc(0, 0.026, 0.029, 0.0369, "light")
    for step in range(1, 9):  # from round to wide
        z = 0.038 + 0.001 * step
        pen.oval(z, z + 0.001, 0.034 * step / 9, 0.0365 - 0.0075 * step / 9, "shell")
    pen.oval(0.047, 0.079, 0.034, 0.0290, "shell")
    pen.oval(0.0535, 0.0545, 0.034, 0.0293, "groove")
    pen.oval(0.079, 0.0815, 0.034, 0.0275, "groove")
    pen.oval(0.0815, 0.0845, 0.034, 0.0285, "housing")
    pen.box((-0.0155, -0.0590, 0.0845), (0.0155, 0.0590, 0.0848), "rubber")
    for x in (-0.0095, 0.0095):
        pen.rod((x, -0.0585, 0.0862), (x, 0.0585, 0.0862), 0.0028, "steel", "cylinder")  # rails
        for y in (-0.0605, 0.0605):
            pen.box((x - 0.004, y - 0.0022, 0.0845), (x + 0.004, y + 0.0022, 0.0895), "housing")
    pen.box((0.0280, -0.020, 0.060), (0.0294, 0.020, 0.074), "housing")  # name plate


def _draw_camera(palm: Any) -> None:
    pen = _Pen(palm)
    x, _, z = _LENS
    pen.box((x - 0.0075, -0.017, z - 0.020), (x + 0.0075, 0.017, z - 0.001), "shell")
    pen.box((x + 0.0075, -0.012, z - 0.016), (-0.028, 0.012, z - 0.005), "housing")
    pen.disc(0, z - 0.001, z + 0.001, 0.0058, "steel", x)
    pen.disc(0, z + 0.001, z + 0.0013, 0.0045, "glass", x)
    forward = np.subtract(_LOOKS_AT, _LENS)
    forward /= np.linalg.norm(forward)
    # Up in the picture is the flange's -x: away from the base where the arm is at home.
    palm.add(
        "camera",
        name="wrist",
        pos=(x, 0, z + 0.002),
        xyaxes=(0, -1, 0, -forward[2], 0, forward[0]),
        fovy=72,
    )


def _draw_finger(finger: Any, sign: int) -> None:
    pen = _Pen(finger, sign)
    pen.box((-0.0130, 0.003, PALM_LENGTH_M), (0.0130, 0.020, 0.0965), "housing")  # carriage
    pen.box((-0.0055, 0.009, 0.0965), (0.0055, 0.0165, 0.132), "shell")
    for side in (-1, 1):
        x, edge = side * 0.0078, side * 0.0137
        pen.rod((x, 0.0140, 0.0985), (x, 0.0120, 0.1300), 0.0054, "link", "capsule")
        for y, z in ((0.0140, 0.0985), (0.0120, 0.1300)):
            pen.rod((x, y, z), (edge, y, z), 0.0038, "shell", "cylinder")  # pins
            pen.rod((x, y, z), (edge + side * 0.0002, y, z), 0.0019, "steel", "cylinder")
    low = TCP_M - PAD_LENGTH_M / 2
    pen.box((-0.0110, PAD_THICK_M, low - 0.004), (0.0110, 0.0145, FINGERTIP_M - 0.003), "tip")
    pen.box((-0.0110, PAD_THICK_M, FINGERTIP_M - 0.003), (0.0110, 0.0115, FINGERTIP_M), "tip")
    half = PAD_WIDTH_M / 2
    pen.box((-half, 0.0, low), (half, PAD_THICK_M - 0.0015, FINGERTIP_M), "rubber")
    pen.box((-half, PAD_THICK_M - 0.0015, low), (half, PAD_THICK_M, FINGERTIP_M), "steel")
    for k in range(1, 6):
        z = low + k * PAD_LENGTH_M / 6
        pen.box((-half - 0.0002, -0.0001, z - 0.0005), (half + 0.0002, 0.0012, z + 0.0005), "groove")
