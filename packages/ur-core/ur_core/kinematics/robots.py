"""Table of Universal Robots' arms; `ur_core.kinematics.robot_model` defines the figures and the estimates.

Sources: lengths, masses and centres of mass: Universal Robots' article "DH Parameters for calculations of kinematics
and dynamics", and `config/<model>/physical_parameters.yaml` of Universal_Robots_ROS2_Description, which has the same
figures with the centres of mass in link frames; where they differ, the later one. Tensors: the same files, except where
these hold a cylinder (UR3, UR5) or the tensors of another model (UR10e, UR12e: UR10's; UR30: UR16e's). Joint speeds and
torques: `config/<model>/joint_limits.yaml`, after the user manuals and the article "Max. joint torques". Payload and
reach: data sheets. Robot types: Universal Robots' client library. Offsets of the tubes: `offsets` of the same files.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

from ur_core.errors import UnknownNameError
from ur_core.kinematics.robot_model import REFERENCE_TORQUE_NM, RobotModel, Six, stretched_inertia
from ur_core.types import Vector3

__all__ = ["MODEL_OF_FAMILY", "MOST_PAYLOAD_KG", "ROBOTS", "RobotModel", "robot_model"]

_SHARED: Final = "the mechanics of {} with a larger payload: Universal_Robots_ROS2_Description"

_Coms = tuple[Vector3, ...]
_Tensors = tuple[Six, ...]

_UR10 = RobotModel(
    name="ur10",
    title="UR10",
    family="cb3",
    robot_type=2,
    # The table in the CB3 manual ("UR10 series 1": d1 0.118, a2 -0.6127, a3 -0.5716) describes other hardware and is
    # 10.7 mm off.
    lengths_m=(0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    mass_kg=(7.1, 12.7, 4.27, 2.0, 2.0, 0.365),
    com_m=(
        (0.021, 0.0, 0.027),
        (0.38, 0.0, 0.158),
        (0.24, 0.0, 0.068),
        (0.0, 0.007, 0.018),
        (0.0, 0.007, 0.018),
        (0.0, 0.0, -0.026),
    ),
    inertia_kg_m2=(
        (0.03408, 0.03529, 0.02156, 0.00002, -0.00425, 0.00008),
        (0.02814, 0.77068, 0.76943, 0.00005, -0.01561, 0.00002),
        (0.01014, 0.30928, 0.30646, 0.00008, 0.00916, 0.0),
        (0.00296, 0.00222, 0.00258, -0.00001, 0.0, -0.00024),
        (0.00296, 0.00222, 0.00258, -0.00001, 0.0, -0.00024),
        (0.00040, 0.00041, 0.00034, 0.0, 0.0, 0.0),
    ),
    joint_speed_deg_s=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
    joint_torque_nm=REFERENCE_TORQUE_NM,
    payload_kg=10.0,
    reach_m=1.3,
    tube_offsets_m=(0.176, 0.048),
    source="tensors: extracted from URSim, by the same file",
)

_UR3E = RobotModel(
    name="ur3e",
    title="UR3e",
    family="e-series",
    robot_type=3,
    lengths_m=(0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    mass_kg=(1.98, 3.4445, 1.437, 0.871, 0.805, 0.261),
    com_m=(
        (0.0, -0.02, 0.0),
        (0.13, 0.0, 0.1157),
        (0.05, 0.0, 0.0238),
        (0.0, 0.0, 0.01),
        (0.0, 0.0, 0.01),
        (0.0, 0.0, -0.02),
    ),
    inertia_kg_m2=(
        (0.0027657, 0.0021501, 0.0025626, 0.0000096, -0.0000149, 0.0001873),
        (0.0042623, 0.0460284, 0.0448947, -0.0000409, -0.0014960, -0.0000129),
        (0.0010511, 0.0113396, 0.0110895, 0.0, -0.0000331, 0.0000022),
        (0.0008174, 0.0006844, 0.0005497, -0.0000005, 0.0000021, 0.0000617),
        (0.0006059, 0.0005837, 0.0003831, -0.0000006, -0.0000006, -0.0000271),
        (0.0001080, 0.0001086, 0.0001371, -0.0000001, -0.0000001, -0.0000002),
    ),
    joint_speed_deg_s=(180.0, 180.0, 180.0, 360.0, 360.0, 360.0),
    joint_torque_nm=(56.0, 56.0, 28.0, 12.0, 12.0, 12.0),
    payload_kg=3.0,
    reach_m=0.5,
    tube_offsets_m=(0.120, 0.027),
)

_UR5E = RobotModel(
    name="ur5e",
    title="UR5e",
    family="e-series",
    robot_type=1,
    lengths_m=(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    mass_kg=(3.761, 8.058, 2.846, 1.37, 1.3, 0.365),
    com_m=(
        (0.0, -0.02561, 0.00193),
        (0.2125, 0.0, 0.11336),
        (0.15, 0.0, 0.0265),
        (0.0, -0.0018, 0.01634),
        (0.0, 0.0018, 0.01634),
        (0.0, 0.0, -0.001159),
    ),
    inertia_kg_m2=(
        (0.00700210, 0.00648091, 0.00657286, 0.00000073, -0.00001053, 0.00049994),
        (0.01505885, 0.33388086, 0.33247207, -0.00005400, 0.00000563, -0.00000181),
        (0.00399632, 0.07879254, 0.07848510, -0.00001365, 0.00137272, -0.00000660),
        (0.00165491, 0.00135962, 0.00126279, -0.00000282, -0.00000438, 0.00010157),
        (0.00135617, 0.00127827, 0.00096614, -0.00000274, 0.00000444, -0.00005048),
        (0.00018694, 0.00018908, 0.00025756, 0.00000006, -0.00000017, -0.00000092),
    ),
    joint_speed_deg_s=(180.0, 180.0, 180.0, 180.0, 180.0, 180.0),
    joint_torque_nm=(150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
    payload_kg=5.0,
    reach_m=0.85,
    tube_offsets_m=(0.138, 0.007),
)

_UR20 = RobotModel(
    name="ur20",
    title="UR20",
    family="e-series",
    robot_type=7,
    lengths_m=(0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543),
    mass_kg=(16.343, 29.632, 7.879, 3.054, 3.126, 0.926),
    com_m=(
        (0.0, -0.061, 0.0062),
        (0.5226, 0.0, 0.2098),
        (0.3234, 0.0, 0.0604),
        (0.0, -0.0026, 0.0393),
        (0.0, 0.0024, 0.0379),
        (0.0, 0.0, -0.0293),
    ),
    inertia_kg_m2=(
        (0.08866, 0.07632, 0.08418, -0.00011, -0.00011, 0.00720),
        (0.14670, 4.66590, 4.63480, 0.00019, -0.05163, 0.00004),
        (0.02612, 0.75763, 0.75327, -0.00005, -0.02898, -0.00001),
        (0.00555, 0.00537, 0.00402, -0.00001, -0.00002, 0.00036),
        (0.00586, 0.00578, 0.00427, -0.00001, -0.00002, -0.00037),
        (0.00092, 0.00091, 0.00117, 0.0, 0.0, 0.0),
    ),
    joint_speed_deg_s=(120.0, 120.0, 150.0, 210.0, 210.0, 210.0),
    joint_torque_nm=(738.0, 738.0, 433.0, 107.0, 107.0, 107.0),
    payload_kg=20.0,
    reach_m=1.75,
    tube_offsets_m=(0.260, 0.043),
    source="mass and centre of mass of wrist 3: the file, later than the article",
)

_UR16E = RobotModel(
    name="ur16e",
    title="UR16e",
    family="e-series",
    robot_type=4,
    lengths_m=(0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
    mass_kg=(7.369, 10.45, 4.321, 2.18, 2.033, 0.907),
    com_m=(
        (0.0, -0.016, 0.03),
        (0.302, 0.0, 0.16),
        (0.194, 0.0, 0.065),
        (0.0, -0.009, 0.011),
        (0.0, 0.018, 0.012),
        (0.0, 0.0, -0.044),
    ),
    inertia_kg_m2=(
        (0.03351, 0.03374, 0.02100, 0.00002, -0.00001, 0.00374),
        (0.02796, 0.47558, 0.47635, -0.00010, -0.00720, 0.00003),
        (0.01091, 0.12060, 0.11714, 0.00006, 0.01012, 0.00001),
        (0.00609, 0.00245, 0.00579, -0.00001, 0.0, 0.00083),
        (0.00389, 0.00219, 0.00363, -0.00001, 0.0, -0.00045),
        (0.00117, 0.00118, 0.00084, 0.0, 0.0, 0.0),
    ),
    joint_speed_deg_s=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
    joint_torque_nm=(330.0, 330.0, 150.0, 54.0, 54.0, 54.0),
    payload_kg=16.0,
    reach_m=0.9,
    tube_offsets_m=(0.176, 0.040),
)

# Shoulder and wrists of UR8 Long, UR15 and UR18 are the same parts.
_SHOULDER_COM: Final[_Coms] = ((0.000024, -0.033309, 0.025304),)
_WRIST_COMS: Final[_Coms] = (
    (0.000025, -0.019695, 0.016413),
    (0.000025, 0.019960, 0.015886),
    (-0.000018, -0.000112, -0.053397),
)
_SHOULDER_TENSOR: Final[_Tensors] = ((0.051334, 0.047702, 0.034263, 0.000025, -0.000016, 0.008805),)
_WRIST_TENSORS: Final[_Tensors] = (
    (0.004339, 0.002548, 0.003912, 0.000019, 0.000001, 0.000706),
    (0.004288, 0.002566, 0.003927, 0.000017, -0.000003, -0.000716),
    (0.001406, 0.001404, 0.001002, -0.000003, 0.000010, -0.000024),
)
_UR18_SPEEDS: Final = (180.0, 180.0, 240.0, 300.0, 300.0, 300.0)
_UR18_TORQUES: Final = (433.0, 433.0, 204.0, 70.0, 70.0, 70.0)


def _of_18(
    name: str,
    title: str,
    robot_type: int,
    tubes_m: tuple[float, float],
    masses_kg: tuple[float, float],
    coms_m: _Coms,
    tensors: _Tensors,
    data_sheet: tuple[float, float],
    offsets_m: tuple[float, float],
    limits_from: str | None,
) -> RobotModel:
    """Return a model that shares shoulder and wrists with the UR18."""
    return RobotModel(
        name=name,
        title=title,
        family="e-series",
        robot_type=robot_type,
        lengths_m=(0.2186, *tubes_m, 0.1824, 0.1361, 0.1434),
        mass_kg=(9.9883, *masses_kg, 2.089, 2.0869, 1.0666),
        com_m=_SHOULDER_COM + coms_m + _WRIST_COMS,
        inertia_kg_m2=_SHOULDER_TENSOR + tensors + _WRIST_TENSORS,
        joint_speed_deg_s=_UR18_SPEEDS,
        joint_torque_nm=_UR18_TORQUES,
        payload_kg=data_sheet[0],
        reach_m=data_sheet[1],
        tube_offsets_m=offsets_m,
        limits_from=limits_from,
        source="offsets of the tubes: estimated from the centres of mass, in the UR10e's proportion",
    )


_UR15 = _of_18(
    "ur15",
    "UR15",
    9,
    (-0.6475, -0.5164),
    (14.9255, 6.1015),
    ((0.419009, -0.000083, 0.192787), (0.305471, 0.000019, 0.070552)),
    (
        (0.048202, 1.188499, 1.182771, 0.000232, -0.032135, -0.000017),
        (0.018481, 0.303502, 0.296843, -0.000005, 0.013601, 0.000003),
    ),
    (15.0, 1.3),
    (0.215, 0.041),
    "ur18",
)
_UR18 = _of_18(
    "ur18",
    "UR18",
    5,
    (-0.475, -0.3389),
    (14.2009, 5.52),
    ((0.308664, -0.000088, 0.190204), (0.199652, 0.000021, 0.073101)),
    (
        (0.045094, 0.630805, 0.625724, 0.000179, -0.024705, -0.000020),
        (0.016891, 0.129732, 0.123451, 0.000000, 0.009081, 0.000003),
    ),
    (18.0, 0.95),
    (0.212, 0.042),
    None,
)
_UR8_LONG = _of_18(
    "ur8long",
    "UR8 Long",
    6,
    (-0.8989, -0.7149),
    (17.0738, 7.6393),
    ((0.565429, -0.000074, 0.195420), (0.416102, 0.000058, 0.065663)),
    (
        (0.056709, 2.440120, 2.432744, 0.000292, -0.054852, -0.000014),
        (0.022148, 0.633274, 0.625889, 0.000052, 0.019779, 0.000003),
    ),
    (8.0, 1.75),
    (0.218, 0.038),
    "ur18",
)


def _estimated(reference: RobotModel, lengths_m: Six, mass_kg: Six) -> tuple[Six, ...]:
    """Return the tensors of another model's links, stretched to these lengths and scaled to these masses."""
    ratios = [1.0, lengths_m[1] / reference.lengths_m[1], lengths_m[2] / reference.lengths_m[2], 1.0, 1.0, 1.0]
    return tuple(
        stretched_inertia(values, mass / old, ratio)
        for values, mass, old, ratio in zip(reference.inertia_kg_m2, mass_kg, reference.mass_kg, ratios, strict=True)
    )


def _like(reference: RobotModel, **changes: Any) -> RobotModel:
    """Return a model that shares figures with another one, with its tensors estimated from that one."""
    changed = replace(reference, **{"source": _SHARED.format(reference.title), **changes})
    if changed.mass_kg == reference.mass_kg and changed.lengths_m == reference.lengths_m:
        return changed
    tensors = _estimated(reference, changed.lengths_m, changed.mass_kg)
    return replace(changed, inertia_kg_m2=tensors, inertia_from=reference.name)


_UR3 = _like(
    _UR3E,
    name="ur3",
    title="UR3",
    family="cb3",
    lengths_m=(0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    mass_kg=(2.0, 3.42, 1.26, 0.8, 0.8, 0.35),
    tube_offsets_m=(0.1198, 0.0275),
    source="",
)
_UR5 = _like(
    _UR5E,
    name="ur5",
    title="UR5",
    family="cb3",
    lengths_m=(0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    mass_kg=(3.7, 8.393, 2.33, 1.219, 1.219, 0.1879),
    tube_offsets_m=(0.13585, 0.0165),
    source="",
)
_UR10E = _like(
    _UR10,
    name="ur10e",
    title="UR10e",
    family="e-series",
    lengths_m=(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    mass_kg=(7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
    payload_kg=12.5,
    tube_offsets_m=(0.1762, 0.0393),
    source="payload: 10 kg on data sheets of older arms",
)
_UR30 = _like(
    _UR20,
    name="ur30",
    title="UR30",
    robot_type=8,
    lengths_m=(0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543),
    mass_kg=(16.343, 28.542, 7.156, 3.054, 3.126, 0.926),
    com_m=(
        (-0.0001, -0.06, 0.0069),
        (0.3894, 0.0, 0.2103),
        (0.2257, 0.0, 0.0629),
        (0.0, -0.0048, 0.0353),
        (0.0, 0.0046, 0.0341),
        (0.0, 0.0, -0.0293),
    ),
    joint_torque_nm=(730.0, 730.0, 430.0, 100.0, 100.0, 100.0),
    payload_kg=30.0,
    reach_m=1.3,
    source="",
)
_UR7E = _like(_UR5E, name="ur7e", title="UR7e", payload_kg=7.5, limits_from="ur5e")
_UR12E = _like(_UR10E, name="ur12e", title="UR12e", joint_torque_nm=(330.0, 330.0, 150.0, 54.0, 54.0, 54.0))

ROBOTS: Final[dict[str, RobotModel]] = {
    model.name: model
    for model in (
        *(_UR3, _UR5, _UR10),
        *(_UR3E, _UR5E, _UR7E, _UR10E, _UR12E, _UR16E),
        *(_UR8_LONG, _UR15, _UR18, _UR20, _UR30),
    )
}
"""All models by name, in families and by payload."""

MODEL_OF_FAMILY: Final[dict[str, str]] = {"cb3": "ur10", "e-series": "ur10e"}
"""Model where only the family of a controller is given."""

MOST_PAYLOAD_KG: Final = max(each.payload_kg for each in ROBOTS.values())
"""Largest payload of any model."""


def robot_model(name: str) -> RobotModel:
    """Return the facts of a model by its name.

    Raises:
        UnknownNameError: There is no such model.
    """
    model = ROBOTS.get(name) if isinstance(name, str) else None
    if model is None:
        raise UnknownNameError("robot model", str(name), tuple(ROBOTS))
    return model
