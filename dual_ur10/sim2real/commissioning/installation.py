"""Finding on the packages of this machine that an upgrade can leave incomplete."""

from __future__ import annotations

from dual_ur10.sim2real.commissioning.findings import Finding


def mujoco_finding() -> Finding:
    """Check that MuJoCo can be imported.

    `pip install -U mujoco` from 3 to 4 leaves it incomplete: files of the new `mujoco-core` are removed with the old
    `mujoco`, which had the same names.
    """
    try:
        import mujoco
    except ImportError as error:
        remedy = "pip install --force-reinstall --no-deps mujoco mujoco-core mujoco-studio"
        found = " ".join(str(error).split()).partition(". ")[0]
        return Finding("machine", "MuJoCo", "fail", f"cannot be imported: {found}", "3.17 to 4, complete", remedy)
    return Finding("machine", "MuJoCo", "ok", mujoco.__version__, "3.17 to 4, complete", "")
