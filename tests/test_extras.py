"""A package that is missing is a named error, which says what needs it and which extra brings it."""

import importlib
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from dual_ur10.assets import visuals
from dual_ur10.errors import MissingExtraError


def imported(name):
    """Return an import of a module."""

    def use(_, monkeypatch):
        monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.import_module(name)

    return use


def called(path, *arguments):
    """Return a call of a function, "module:name"."""
    module, _, name = path.partition(":")
    return lambda *_: getattr(importlib.import_module(module), name)(*arguments)


def read(path, *arguments):
    """Return a call of a function that reads a file in YAML."""

    def use(folder, _):
        (folder / "file.yaml").write_text("a: 1")
        called(path, folder / "file.yaml", *arguments)()

    return use


def template(_, monkeypatch):
    page = importlib.import_module("dual_ur10.sim2real.analysis.page")
    page._environment.cache_clear()
    page.render("page.html")


def without_emulator(_, monkeypatch):
    module = importlib.import_module("dual_ur10.emulated")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    importlib.reload(module)


# Extra, package that is missing, and what needs it.
USES = (
    ("calibration", "cv2", called("dual_ur10.sim2real.calibration.board:opencv")),
    ("calibration", "scipy.stats", called("dual_ur10.sim2real.calibration.intervals:scipy_module", "stats")),
    ("calibration", "yaml", read("dual_ur10.sim2real.calibration.ur_calibration:read", "ur10")),
    ("cameras", "av", called("dual_ur10.sim2real.cameras.pyav:pyav", "a video")),
    ("data", "minari", called("dual_ur10.policies.evaluation.minari_export:to_minari", [], "x-v0")),
    ("dm", "dm_env", imported("dual_ur10.envs.api.dm_env")),
    ("dynamics", "pinocchio", called("ur_core.kinematics.dynamics:_model", "ur10", 0.123, (0.0, 0.0, 0.0), True)),
    ("emulator", "ur_emulator", without_emulator),
    ("lerobot", "av", called("dual_ur10.lerobot.image_video:check_video", Path("none.mp4"), 1)),
    ("lerobot", "pyarrow.parquet", imported("dual_ur10.lerobot.dataset_reader")),
    ("live", "viser", called("dual_ur10.envs.rendering.live.guard:make_server", None, "", "", None)),
    ("plot", "jinja2", template),
    ("plot", "matplotlib.figure", called("dual_ur10.policies.training.progress:draw_curve", Path(), "", ())),
    ("real", "rtde_control", called("dual_ur10.sim2real.runtime.arm_process:_ur_rtde", "127.0.0.2")),
    ("real", "scipy.interpolate", imported("dual_ur10.sim2real.trajectory.interpolation")),
    ("real", "yaml", read("dual_ur10.sim2real.trajectory.files:read_trajectory")),
    ("records", "mcap.data_stream", imported("dual_ur10.sim2real.recording.scan")),
    ("records", "scipy.interpolate", called("dual_ur10.sim2real.analysis.series:interpolate", *(np.zeros(2),) * 3)),
    ("records", "tomlkit", imported("dual_ur10.sim2real.analysis.cell_update")),
    ("remote", "msgspec", imported("dual_ur10.policies.remote")),
    ("remote", "websockets", imported("dual_ur10.policies.remote")),
    ("serial", "serial", called("dual_ur10.sim2real.serial_arm.serial_line:SerialTransport", "/dev/none", 9600)),
    ("teleop", "sdl2", called("dual_ur10.policies.operators.sdl:load", "a gamepad")),
    ("train", "stable_baselines3", imported("dual_ur10.policies.training.models")),
    ("train", "stable_baselines3.common.vec_env", imported("dual_ur10.envs.api.sb3_bridge")),
    ("virtual", "greenlet", imported("ur_emulator.virtual.scheduler")),
)


DISTRIBUTIONS = {"pinocchio": "ur-core", "greenlet": "ur-emulator"}


@pytest.mark.parametrize(("extra", "package", "use"), USES, ids=[f"{extra}-{package}" for extra, package, _ in USES])
def test_a_missing_package_is_named_with_its_extra(extra, package, use, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        MissingExtraError, match=re.escape(f'pip install "{DISTRIBUTIONS.get(package, "dual-ur10")}[{extra}]"')
    ):
        use(tmp_path, monkeypatch)


def test_meshes_that_are_missing_are_named_with_their_extra(monkeypatch):
    def none(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(visuals.importlib.metadata, "distribution", none)
    with pytest.raises(MissingExtraError, match=r"dual-ur10\[meshes\]"):
        visuals._mesh_folder()


def test_every_extra_has_such_a_test():
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text()
    extras = tomllib.loads(text)["project"]["optional-dependencies"].keys()
    of_the_project = {"dev", "docs", "fuzz", "test"}
    assert {extra for extra, *_ in USES} | {"all", "meshes", "rllib"} == extras - of_the_project
