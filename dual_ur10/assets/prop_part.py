"""Pose of a part of a prop that its joints move, such as the lid of a case."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from dual_ur10.assets.prop import Prop
from dual_ur10.errors import UnknownNameError
from ur_core.kinematics.poses import Poses, compose
from ur_core.kinematics.rotations import quat_from_rotvec, rotate
from ur_core.types import Array


class _Joint(NamedTuple):
    """Joint of a body.

    Attributes:
        name: Its name in `CellState.joints`.
        slides: It slides; otherwise it is a hinge.
        anchor_m: (3,) point on its axis, in the frame of the body.
        axis: (3,) its axis in that frame, of unit length.
        zero: Its position at which the body is where the MJCF has it.
    """

    name: str
    slides: bool
    anchor_m: Array
    axis: Array
    zero: float

    def moved(self, joints: Mapping[str, Array]) -> Poses:
        """Return the displaced frames, (n, ...), of the body in its own."""
        by = np.asarray(joints[self.name], dtype=np.float64)[..., None] - self.zero
        if self.slides:
            return Poses(by * self.axis, np.array([1.0, 0.0, 0.0, 0.0]))
        quat = quat_from_rotvec(by * self.axis)
        return Poses(self.anchor_m - rotate(quat, self.anchor_m), quat)


class PropPart:
    """Pose of a body of a prop, from the pose of the prop and the positions of its joints.

    Args:
        prop: The prop.
        body: Name of the body in its MJCF.

    Raises:
        UnknownNameError: The prop has no such body.
        SettingsError: MuJoCo refuses the prop.
    """

    def __init__(self, prop: Prop, body: str) -> None:
        import mujoco

        self._prop = prop.name
        prop.check()
        spec = mujoco.MjSpec()
        prop.add_to(spec, 0.002, visuals=False)
        model = spec.compile()
        names = [model.body(each).name.removeprefix(f"{prop.name}/") for each in range(1, model.nbody)]
        if not body or body not in names:
            raise UnknownNameError(f"body of the prop {prop.name!r}", body, [each for each in names if each])
        number, self._chain = 1 + names.index(body), list[tuple[Poses, list[_Joint]]]()
        while number > 0:
            at = Poses(model.body_pos[number].copy(), model.body_quat[number].copy())
            self._chain.insert(0, (at, _joints(model, number, prop.name)))
            number = int(model.body_parentid[number])

    def __call__(self, n: int, objects: Mapping[str, Poses], joints: Mapping[str, Array]) -> Poses:
        """Return the poses of the body, (n, 3) and (n, 4).

        Args:
            n: Number of cells.
            objects: Poses of props, as in `CellState.objects`; a prop that is not there is where its MJCF has it.
            joints: Positions of the joints, as in `CellState.joints`.
        """
        pose = objects.get(self._prop, self._chain[0][0])
        for depth, (at, hinges) in enumerate(self._chain):
            if depth > 0:
                pose = compose(pose, at)
            for joint in hinges:
                pose = compose(pose, joint.moved(joints))
        return Poses(np.broadcast_to(pose.position_m, (n, 3)), np.broadcast_to(pose.quat, (n, 4)))


def _joints(model: Any, body: int, prop: str) -> list[_Joint]:
    """Return the hinges and slides of a body, in their order."""
    first, found = int(model.body_jntadr[body]), []
    for number in range(first, first + int(model.body_jntnum[body])):
        joint = model.joint(number)
        if joint.type[0] > 1:  # neither free nor a ball
            name, zero = joint.name.removeprefix(f"{prop}/"), float(joint.qpos0[0])
            found.append(_Joint(name, joint.type[0] == 2, joint.pos.copy(), joint.axis.copy(), zero))
    return found
