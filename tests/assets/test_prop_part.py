"""Poses of parts of props, against MuJoCo."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.assets.prop import Prop
from dual_ur10.assets.prop_part import PropPart
from ur_core.errors import UnknownNameError
from ur_core.kinematics.poses import Poses

GEOM = "<geom type='box' size='.02 .02 .02' mass='.1'/>"
MJCF = f"""
<mujoco><compiler angle="radian"/><worldbody><body {{}} pos=".1 .2 .3" euler=".3 .2 .1">{{}}{GEOM}
  <body name="drawer" pos=".1 0 .02" euler="0 .4 0">
    <joint name="pull" type="slide" axis="1 1 0" ref=".01"/><joint name="tilt" axis="0 1 .5" pos=".02 .01 0"/>{GEOM}
    <body name="handle" pos="0 .05 0"><body name="knob" pos=".01 .02 .03"><joint name="turn" axis="0 0 1"/>{GEOM}</body>
    </body>
  </body>
</body></worldbody></mujoco>"""
KINDS = {"fixed": ("", ""), "placed": ("mocap='true'", ""), "free": ("", "<freejoint/>")}
POSE = (0.4, -0.2, 0.1, 0.5, 0.5, -0.5, 0.5)


@settings(max_examples=20)
@given(
    kind=st.sampled_from(list(KINDS)),
    body=st.sampled_from(["body", "drawer", "handle", "knob"]),
    positions=st.lists(st.tuples(*[st.floats(-3.0, 3.0)] * 3), min_size=1, max_size=3),
)
def test_a_part_is_where_mujoco_has_it(kind, body, positions):
    prop = Prop(name="chest", mjcf=MJCF.format(*KINDS[kind]))
    spec = mujoco.MjSpec()
    prop.add_to(spec, 0.002)
    model = spec.compile()
    data, n = mujoco.MjData(model), len(positions)
    names = ("pull", "tilt", "turn")
    objects = {} if kind == "fixed" else {"chest": Poses(*np.split(np.tile(POSE, (n, 1)), [3], axis=1))}
    found = PropPart(prop, body)(n, objects, dict(zip(names, np.array(positions).T, strict=True)))
    for row, values in enumerate(positions):
        if kind == "free":
            data.qpos[:7] = POSE
        if kind == "placed":
            data.mocap_pos[0], data.mocap_quat[0] = POSE[:3], POSE[3:]
        for name, value in zip(names, values, strict=True):
            data.joint(f"chest/{name}").qpos[:] = value
        mujoco.mj_kinematics(model, data)
        there = data.body(f"chest/{body}")
        np.testing.assert_allclose(found.position_m[row], there.xpos, atol=1e-12)
        assert abs(found.quat[row] @ there.xquat) == pytest.approx(1.0, abs=1e-12)


def test_a_body_that_is_not_there_is_refused():
    with pytest.raises(UnknownNameError, match=r"body of the prop 'chest' 'lid'.*'drawer', 'handle', 'knob'"):
        PropPart(Prop(name="chest", mjcf=MJCF.format("", "")), "lid")
