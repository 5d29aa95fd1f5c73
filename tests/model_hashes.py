"""Hashes of the compiled models of some cells: with visuals, without, and the collision model.

A hash is of all names and of the fields below, rounded to 1e-9, which all processors and MuJoCo versions agree on.
"""

import hashlib

import mujoco
import numpy as np

FIELDS = (
    *("body_parentid", "body_mocapid", "body_pos", "body_quat", "body_ipos", "body_mass", "body_gravcomp"),
    *("jnt_type", "jnt_bodyid", "jnt_pos", "jnt_axis", "jnt_limited", "jnt_range", "jnt_actfrcrange", "jnt_solref"),
    *("jnt_actgravcomp", "dof_armature", "dof_damping", "qpos0", "geom_type", "geom_bodyid", "geom_contype"),
    *("geom_conaffinity", "geom_condim", "geom_group", "geom_priority", "geom_size", "geom_pos", "geom_rgba"),
    *("geom_friction", "geom_solref", "geom_solimp", "geom_matid", "geom_dataid", "site_bodyid", "site_pos"),
    *("site_quat", "site_group", "cam_bodyid", "cam_pos", "cam_quat", "cam_fovy", "light_pos", "light_dir"),
    *("light_cutoff", "light_diffuse", "mat_rgba", "mat_specular", "mat_shininess", "mat_emission", "mat_texid"),
    *("mat_texrepeat", "tex_data", "mesh_vert", "exclude_signature", "eq_type", "eq_obj1id", "eq_obj2id", "eq_data"),
    *("eq_solref", "eq_solimp", "wrap_objid", "wrap_prm", "actuator_trntype", "actuator_trnid", "actuator_gainprm"),
    *("actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange", "sensor_type", "sensor_objid", "sensor_refid"),
    *("sensor_cutoff",),
)


def hash_of(model: mujoco.MjModel) -> str:
    """Return the hash of a model."""
    found = hashlib.sha256(bytes(model.names))
    for name in FIELDS:
        found.update(name.encode() + (np.round(getattr(model, name).astype(float), 9) + 0.0).tobytes())
    option = model.opt
    found.update(repr((option.timestep, option.integrator, option.cone, option.impratio, option.disableflags)).encode())
    return found.hexdigest()[:16]


HASHES: dict[str, tuple[str, str, str]] = {
    "default": ("c0a600305c0ab616", "a23d2a9edb2e0514", "974ccd57752ccfd3"),
    "unequal": ("574ae0b31187a053", "1757da7d2ef2258e", "ee66015fc488797d"),
    "grippers": ("88d4bc001eff9686", "413ec3080a0e05a7", "b90a36ccc357ac0f"),
    "bar": ("b5cbce7a77b35ca0", "b87a2877b9fc065a", "749d95f9dfd34b9a"),
    "block": ("9eea85397bfd8522", "1e55726661c03763", "023eb4680f833df3"),
    "welded": ("38b72796b5af189b", "44a036b29306c76f", "749d95f9dfd34b9a"),
    "bar alone": ("1f4eecb6f3154598", "27786365070eff9f", "d811b8757521d50f"),
    "obstacles": ("efc05f99f60518ea", "aa343cb15b7fbf29", "6a9f3553c016a0c9"),
    "UR3e and UR20": ("a8e0c4d3a39b1f27", "af0e389b5f7975ff", "18890248995481cc"),
}
