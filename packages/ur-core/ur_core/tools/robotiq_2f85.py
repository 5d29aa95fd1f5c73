"""Robotiq 2F-85: its figures, and how it is drawn.

Fingers slide in place of the real one's linkage. The real worm gear holds against any load; in simulation, the gripper
yields to a force on one finger that exceeds the grip force.
"""

from __future__ import annotations

from typing import Any, Final

from ur_core.mjcf.camera import Camera
from ur_core.tools.pen import Pen
from ur_core.tools.tool import Tool

_LENS: Final = (-0.0445, 0.0, 0.078)
_IN_FRONT_M: Final = 0.002  # from the drawn lens to the point of view
_AIM: Final = (0.0, 0.0, 0.20 + _IN_FRONT_M)

ROBOTIQ_2F85: Final = Tool(
    name="robotiq_2f85",
    title="Robotiq 2F-85",
    drivers=("robotiq", "digital_output"),
    tcp_m=0.15,
    stroke_m=0.085,  # data sheet, like speed, force and mass
    speed_m_s=(0.02, 0.15),
    force_n=(20.0, 235.0),
    mass_kg=0.925,
    com_m=0.047,
    palm_m=0.086,
    palm_size_m=(0.07, 0.10),
    # Edges of the visual palm and its camera protrude by up to 12 mm.
    palm_radius_m=0.05,
    palm_half_m=0.035,
    palm_z_m=0.048,
    finger_mass_kg=0.06,
    finger_width_m=0.028,
    finger_thick_m=0.020,
    pad_m=(0.022, 0.007, 0.038),
    # 200 rad/s, critically damped with both fingers' inertia; the lag in a ramp is kv / kp = 11 ms.
    servo_kp=20_000.0,
    servo_kv=220.0,
    # The real one has a worm gear and cannot be pushed open; its rotor's inertia is not published. This value makes the
    # servo well damped at any timestep of a few ms.
    armature_kg=1.0,
    visuals="ur_core.tools.robotiq_2f85:draw",
    # Upwards in the image is away from the base where the arm is at home.
    cameras=(Camera("wrist", (_LENS[0], 0.0, _LENS[2] + _IN_FRONT_M), _AIM, 72.0, up=(-1.0, 0.0, 0.0)),),
)

_MATERIALS: Final = {
    "shell": ((0.21, 0.22, 0.24, 1), 0.5, 0.5),
    "link": ((0.46, 0.48, 0.51, 1), 0.6, 0.6),
    "tip": ((0.32, 0.33, 0.36, 1), 0.4, 0.5),
    "steel": ((0.70, 0.72, 0.75, 1), 0.8, 0.8),
    "light": ((0.25, 0.65, 0.95, 1), 0.2, 0.2),
    "groove": ((0.20, 0.20, 0.22, 1), 0.1, 0.1),
    "glass": ((0.05, 0.07, 0.14, 1), 0.9, 0.9),
}  # colour, specular, shininess


def draw(arm: Any, tool: Tool) -> None:
    """Add the visuals of the gripper to an arm's spec."""
    for name, (rgba, specular, shininess) in _MATERIALS.items():
        arm.add_material(
            name=name, rgba=rgba, specular=specular, shininess=shininess, emission=0.5 if name == "light" else 0.0
        )
    _draw_palm(Pen(arm, "gripper"))
    _draw_camera(Pen(arm, "gripper"))
    for i, sign in ((1, 1), (2, -1)):
        _draw_finger(Pen(arm, f"finger_{i}", sign), tool)


def _draw_palm(pen: Pen) -> None:
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


def _draw_camera(pen: Pen) -> None:
    x, _, z = _LENS
    pen.box((x - 0.0075, -0.017, z - 0.020), (x + 0.0075, 0.017, z - 0.001), "shell")
    pen.box((x + 0.0075, -0.012, z - 0.016), (-0.028, 0.012, z - 0.005), "housing")
    pen.disc(0, z - 0.001, z + 0.001, 0.0058, "steel", x)
    pen.disc(0, z + 0.001, z + 0.0013, 0.0045, "glass", x)


def _draw_finger(pen: Pen, tool: Tool) -> None:
    (width, thick, length), tip = tool.pad_m, tool.fingertip_m
    pen.box((-0.0130, 0.003, tool.palm_m), (0.0130, 0.020, 0.0965), "housing")  # carriage
    pen.box((-0.0055, 0.009, 0.0965), (0.0055, 0.0165, 0.132), "shell")
    for side in (-1, 1):
        x, edge = side * 0.0078, side * 0.0137
        pen.rod((x, 0.0140, 0.0985), (x, 0.0120, 0.1300), 0.0054, "link", "capsule")
        for y, z in ((0.0140, 0.0985), (0.0120, 0.1300)):
            pen.rod((x, y, z), (edge, y, z), 0.0038, "shell", "cylinder")  # pins
            pen.rod((x, y, z), (edge + side * 0.0002, y, z), 0.0019, "steel", "cylinder")
    low = tool.tcp_m - length / 2
    pen.box((-0.0110, thick, low - 0.004), (0.0110, 0.0145, tip - 0.003), "tip")
    pen.box((-0.0110, thick, tip - 0.003), (0.0110, 0.0115, tip), "tip")
    half = width / 2
    pen.box((-half, 0.0, low), (half, thick - 0.0015, tip), "rubber")
    pen.box((-half, thick - 0.0015, low), (half, thick, tip), "steel")
    for k in range(1, 6):
        z = low + k * length / 6
        pen.box((-half - 0.0002, -0.0001, z - 0.0005), (half + 0.0002, 0.0012, z + 0.0005), "groove")
