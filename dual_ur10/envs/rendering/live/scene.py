"""Bodies of MuJoCo's model of a cell as meshes for a browser."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

MOVED_M: Final = 1e-4
"""Change of a pose below which it is not sent."""

_DRAWN_GROUPS: Final = 3  # geoms of groups 0, 1 and 2 are drawn, as in MuJoCo's viewers
_SIDES: Final = 16  # of a cylinder: fewer make a browser without a GPU faster
_PLANE_M: Final = 6.0


class Part(NamedTuple):
    """One mesh of one colour.

    Attributes:
        body: Number of the body that carries it.
        vertices: (k, 3) m, in the body's frame.
        faces: (m, 3) numbers of vertices.
        rgb: Red, green and blue, 0 to 255.
        opacity: 0 to 1.
    """

    body: int
    vertices: Array
    faces: NDArray[np.uint32]
    rgb: tuple[int, int, int]
    opacity: float


def parts_of(model: Any) -> list[Part]:
    """Return the meshes of a model, those of one body and colour in one."""
    found: dict[tuple[int, tuple[int, int, int], float], list[tuple[Array, NDArray[np.uint32]]]] = {}
    for geom in range(model.ngeom):
        if model.geom_group[geom] >= _DRAWN_GROUPS:
            continue
        material = int(model.geom_matid[geom])
        rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        if rgba[3] <= 0.0:
            continue
        red, green, blue = np.rint(255 * rgba[:3]).astype(int).tolist()
        key = int(model.geom_bodyid[geom]), (red, green, blue), round(float(rgba[3]), 2)
        vertices, faces = _mesh(model, geom)
        if not len(faces):
            continue
        placed = vertices @ quat_to_matrix(model.geom_quat[geom]).T + model.geom_pos[geom]
        found.setdefault(key, []).append((placed, faces))
    return [Part(body, *_joined(meshes), rgb, opacity) for (body, rgb, opacity), meshes in found.items()]


def swollen(vertices: Array, faces: NDArray[np.uint32], by_m: float) -> Array:
    """Return the vertices of a mesh, (k, 3), each moved outwards along the mean normal of its faces."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(total, faces[:, corner], normal)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    result: Array = vertices + by_m * total / np.maximum(length, 1e-12)
    return result


def _joined(meshes: list[tuple[Array, NDArray[np.uint32]]]) -> tuple[Array, NDArray[np.uint32]]:
    first = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [each + at for (_, each), at in zip(meshes, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces).astype(np.uint32)


def _mesh(model: Any, geom: int) -> tuple[Array, NDArray[np.uint32]]:
    """Return vertices and faces of a geom in its own frame."""
    import mujoco

    kinds = mujoco.mjtGeom
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == kinds.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
        return vertices.astype(np.float64), faces.astype(np.uint32)
    if kind == kinds.mjGEOM_PLANE:
        half = np.where(size[:2] > 0.0, size[:2], _PLANE_M)
        return _box(np.array([half[0], half[1], 0.001]))
    if kind == kinds.mjGEOM_BOX:
        return _box(size)
    if kind == kinds.mjGEOM_CYLINDER:
        # Rims are doubled, so that shading does not round them.
        radius, half_m = size[0], size[1]
        return _turned(np.array([0.0, radius, radius, radius, radius, 0.0]), half_m * np.array([1, 1, 1, -1, -1, -1]))
    angle = np.linspace(0.0, np.pi, _SIDES // 2 + 1)
    if kind == kinds.mjGEOM_CAPSULE:
        half_m = np.where(angle <= np.pi / 2, size[1], -size[1])
        middle = len(angle) // 2
        radii, heights = size[0] * np.sin(angle), size[0] * np.cos(angle) + half_m
        return _turned(np.insert(radii, middle, size[0]), np.insert(heights, middle + 1, -size[1]))
    if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
        vertices, faces = _turned(np.sin(angle), np.cos(angle))
        return vertices * (size[0] if kind == kinds.mjGEOM_SPHERE else size), faces
    return np.zeros((0, 3)), np.zeros((0, 3), np.uint32)  # height fields and signed distances, which no cell has


def _turned(radii: Array, heights: Array) -> tuple[Array, NDArray[np.uint32]]:
    """Return a profile, from the top down, turned about the vertical."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    x, y = radii[:, None] * np.cos(angle), radii[:, None] * np.sin(angle)
    vertices = np.stack([x, y, np.broadcast_to(heights[:, None], x.shape)], axis=-1).reshape(-1, 3)
    row, column = np.divmod(np.arange((len(radii) - 1) * _SIDES), _SIDES)
    here, there = row * _SIDES + column, row * _SIDES + (column + 1) % _SIDES
    faces = np.concatenate(
        [np.stack([here, here + _SIDES, there], 1), np.stack([there, here + _SIDES, there + _SIDES], 1)]
    )
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return vertices, faces[areas > 1e-12].astype(np.uint32)


def _box(half_m: Array) -> tuple[Array, NDArray[np.uint32]]:
    """Return a box, each side with vertices of its own, so that shading does not round its edges."""
    vertices: list[Array] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.zeros((4, 3))
            side[:, axis] = sign
            side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = (-1, 1, 1, -1), (-1, -1, 1, 1)
            first = 4 * len(vertices)
            turn = (0, 1, 2, 3) if sign > 0.0 else (3, 2, 1, 0)
            faces += [[first + turn[each] for each in corner] for corner in ((0, 1, 2), (0, 2, 3))]
            vertices.append(side)
    return np.concatenate(vertices) * half_m, np.array(faces, dtype=np.uint32)


class Poser:
    """Poses of all bodies of a cell, and of its arms' targets.

    Args:
        model: MuJoCo's model of the cell.

    Attributes:
        arm_bodies: Numbers of the bodies of both arms that move.
        tools: Names of the sites of both tools: the tool centre point, or the flange without a gripper.
    """

    def __init__(self, model: Any) -> None:
        import mujoco

        self._mujoco, self._model = mujoco, model
        self._cell, self._target = mujoco.MjData(model), mujoco.MjData(model)
        sites = {model.site(number).name for number in range(model.nsite)}
        self.tools = tuple(f"{arm}/tcp" if f"{arm}/tcp" in sites else f"{arm}/flange" for arm in ARMS)
        self._joints = arm_rows(model)
        fixed = {number for number in range(model.nbody) if model.body_weldid[number] == 0}
        self.arm_bodies = [
            number
            for number in range(model.nbody)
            if number not in fixed and model.body(number).name.startswith(tuple(f"{arm}/" for arm in ARMS))
        ]

    def pose(self, qpos: Array, mocap: Array, commanded_rad: Array) -> None:
        """Set the cell to its positions, and the targets to the commanded joints, (2, 6)."""
        cell, target = self._cell, self._target
        cell.qpos[:], target.qpos[:] = qpos, qpos
        if self._model.nmocap:
            cell.mocap_pos[:], cell.mocap_quat[:] = mocap[:, :3], mocap[:, 3:]
        target.qpos[self._joints] = commanded_rad.reshape(12)
        self._mujoco.mj_kinematics(self._model, cell)
        self._mujoco.mj_kinematics(self._model, target)

    def rest(self, q_rad: Array) -> None:
        """Set both arms and their targets to joint positions, (2, 6), and all else to where the model has it."""
        qpos, cell = self._model.qpos0.copy(), self._cell
        qpos[self._joints] = q_rad.reshape(12)
        self.pose(qpos, np.hstack([cell.mocap_pos, cell.mocap_quat]), q_rad)

    @property
    def data(self) -> Any:
        """MuJoCo's data of the cell."""
        return self._cell

    def body(self, number: int, *, target: bool = False) -> tuple[Array, Array]:
        """Return position and quaternion of a body in the cell frame, or of its target."""
        data = self._target if target else self._cell
        return data.xpos[number], data.xquat[number]

    def away_m(self) -> list[float]:
        """Return the distance of each tool from its target, m."""
        return [float(np.linalg.norm(self._cell.site(name).xpos - self._target.site(name).xpos)) for name in self.tools]

    def tool_targets(self) -> Array:
        """Return the commanded poses of both tools in the cell frame, (2, 7)."""
        poses = np.zeros((2, 7))
        for row, name in enumerate(self.tools):
            site = self._target.site(name)
            poses[row, :3] = site.xpos
            self._mujoco.mju_mat2Quat(poses[row, 3:], site.xmat)
        return poses


def arm_rows(model: Any) -> list[int]:
    """Return the rows of `qpos` of the left arm's six joints, then of the right arm's."""
    names = [model.joint(number).name for number in range(model.njnt)]
    of_arms = [[number for number, name in enumerate(names) if name.startswith(f"{arm}/")][:6] for arm in ARMS]
    return [int(model.jnt_qposadr[number]) for each in of_arms for number in each]
