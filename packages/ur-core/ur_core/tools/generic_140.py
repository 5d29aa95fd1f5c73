"""A generic parallel gripper, longer and wider than a Robotiq 2F-85: 140 mm stroke, 0.2 m to the tool centre point.

No product: its figures are plausible ones of its class, and it answers the protocol of Robotiq's URCap, or follows a
digital output. It shows that a gripper is data.
"""

from __future__ import annotations

from typing import Final

from ur_core.tools.tool import Tool

GENERIC_140: Final = Tool(
    name="generic_140",
    title="generic parallel gripper, 140 mm stroke",
    drivers=("robotiq", "digital_output"),
    tcp_m=0.2,
    stroke_m=0.14,
    speed_m_s=(0.02, 0.2),
    force_n=(10.0, 125.0),
    mass_kg=1.3,
    com_m=0.05,
    palm_m=0.11,
    palm_size_m=(0.08, 0.15),
    palm_radius_m=0.055,
    palm_half_m=0.055,
    palm_z_m=0.056,
    finger_mass_kg=0.1,
    finger_width_m=0.032,
    finger_thick_m=0.022,
    pad_m=(0.026, 0.008, 0.036),
    servo_kp=20_000.0,
    servo_kv=220.0,
    armature_kg=1.0,
)
