"""Refusals: structures that do not fit, and libraries that are missing, foreign or of other sources."""

from __future__ import annotations

import ast
import copy
import ctypes
import importlib.util
import pickle
import pkgutil
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import Envelope, MotionLimits
from tests.sim2real.control.motion_checks import AlwaysClear
from ur_core import kernel, kinematics
from ur_core.errors import KernelError
from ur_core.kernel import Constants, Struct
from ur_core.kinematics.ur10 import NOMINAL_DH

ROOT = Path(__file__).parents[2]
CORE = ROOT / "packages" / "ur-core"


def fitting() -> dict[str, object]:
    return {
        "pairs": 2,
        "levers": np.zeros((2, 12)),
        "measure": "clearance_spare",
        "slopes": "measured_slopes",
        "context": None,
    }


def test_a_structure_takes_what_fits() -> None:
    struct = kernel.Struct("Distances", **fitting())
    assert struct.address > 0


def test_a_missing_field_is_named() -> None:
    values = fitting()
    del values["levers"]
    with pytest.raises(
        KernelError, match=r"Distances has the fields pairs, levers, .* missing or unknown: \['levers'\]"
    ):
        kernel.Struct("Distances", **values)


def test_an_unknown_field_is_named() -> None:
    with pytest.raises(KernelError, match=r"missing or unknown: \['lever'\]"):
        kernel.Struct("Distances", **fitting(), lever=1.0)


@pytest.mark.parametrize(
    ("levers", "found"),
    [
        (np.zeros((2, 12), dtype=np.float32), "must be a contiguous array of float64"),
        (np.zeros((2, 12), dtype=np.int64), "must be a contiguous array of float64"),
        (np.zeros((2, 24))[:, ::2], "must be a contiguous array of float64"),
        (np.zeros((12, 2)).T, "must be a contiguous array of float64"),
        (np.zeros((2, 12)).tolist(), "must be a contiguous array of float64"),
        (np.zeros((3, 12)), r"must have pairs x 12 = 24 values, found 36"),
        (np.zeros(12), r"must have pairs x 12 = 24 values, found 12"),
    ],
)
def test_an_array_that_does_not_fit_is_refused(levers: object, found: str) -> None:
    with pytest.raises(KernelError, match=rf"Distances\.levers {found}"):
        kernel.Struct("Distances", **fitting() | {"levers": levers})


@pytest.mark.parametrize("array", [np.zeros(12, dtype=np.float32), np.zeros(24)[::2], np.zeros((3, 4)).T])
def test_a_function_takes_only_contiguous_numbers(array: np.ndarray) -> None:
    with pytest.raises(KernelError, match="contiguous float64 arrays, found"):
        kernel.call("clearance_spare", 0, array, np.zeros(1))


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ((np.zeros(78), np.zeros((3, 18)), 4), "argument 1 of forward_pose must have 72 values, found 54"),
        ((np.zeros(77), np.zeros((3, 18)), 3), "argument 0 of forward_pose must have 78 values, found 77"),
        ((np.zeros(78), 3, 3), "argument 1 of forward_pose must have 54 values, found None"),
        ((np.zeros(78), np.zeros((3, 18))), "forward_pose takes 3 arguments, found 2"),
    ],
)
def test_a_function_takes_only_arrays_of_its_sizes(arguments: tuple[Any, ...], found: str) -> None:
    with pytest.raises(KernelError, match=found):
        kernel.call("forward_pose", *arguments)


def test_sizes_come_from_fields_of_structures() -> None:
    struct, path, each = kernel.Struct("Distances", **fitting()), np.zeros(24), np.zeros(2)
    with pytest.raises(KernelError, match="argument 3 of clear_fractions must have 2 values, found 3"):
        kernel.call("clear_fractions", struct, path, each, np.zeros(3), each, 1)
    with pytest.raises(KernelError, match="a structure with the field pairs is needed, found 0"):
        kernel.call("clear_fractions", 0, path, each, each, each, 1)


def test_every_function_of_arrays_declares_their_sizes() -> None:
    """Those that take a structure and its rows get the sizes from that."""
    sources = "\n".join(path.read_text() for path in sorted(kernel.FOLDER.glob("*.?pp")))
    functions = dict(re.findall(r"^EXPORT \w+ (\w+)\(([^)]*)\)", sources, re.MULTILINE))
    taking = {name for name, arguments in functions.items() if "double*" in arguments}
    declared = dict(re.findall(r'^SIZES\((\w+), "([^"]*)"\)', sources, re.MULTILINE))
    assert set(declared) == taking
    for name, sizes in declared.items():
        kinds = ["double*" in each for each in functions[name].split(",")]
        assert [each != "-" for each in sizes.split()] == kinds, name


def test_no_array_of_a_structure_is_replaced() -> None:
    """The kernel would go on with the former one. Whoever replaces an array makes the structure anew."""
    for path in sorted([*(ROOT / "dual_ur10").rglob("*.py"), *(ROOT / "packages").rglob("*.py")]):
        source = path.read_text()
        if "Struct(" not in source:
            continue
        for owner in ast.walk(ast.parse(source)):
            if not isinstance(owner, ast.ClassDef):
                continue
            functions = [each for each in owner.body if isinstance(each, ast.FunctionDef)]
            for making in functions:
                shared = set(_given_to_structures(making))
                for function in functions:
                    later = function is not making and function.name != "__init__"
                    replaced = shared.intersection(_assigned(function)) if later else set()
                    assert not replaced, f"{path.name}: {owner.name}.{function.name} replaces {replaced}"


def _given_to_structures(function: ast.FunctionDef) -> Iterator[str]:
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Struct":
            yield from (name for each in node.keywords if each.arg for name in _own(each.value))


def _assigned(function: ast.FunctionDef) -> Iterator[str]:
    for node in ast.walk(function):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if isinstance(node, ast.Assign | ast.AnnAssign):
            yield from (name for target in targets for name in _own(target))


def _own(node: ast.AST | None) -> Iterator[str]:
    """Names of the attributes of `self` that an expression is, or has as elements."""
    if isinstance(node, ast.Tuple):
        for each in node.elts:
            yield from _own(each)
    elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "self":
        yield node.attr


def test_counters_are_read_written_and_exchanged() -> None:
    values = np.zeros(3, dtype=np.int64)
    counters = kernel.Counters(values)
    counters[2] = 2**40
    counters[0] = -1
    assert values.tolist() == [counters[0], counters[1], counters[2]] == [-1, 0, 2**40]
    assert counters.swap(2, 2**40, 5)
    assert not counters.swap(2, 2**40, 6)
    assert values.tolist() == [-1, 0, 5]
    with pytest.raises(IndexError):
        counters[3] = 1


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy of the compiled package that the loader looks at."""
    folder = tmp_path / "kernel"
    shutil.copytree(kernel.FOLDER, folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(kernel, "FOLDER", folder)
    monkeypatch.setattr(kernel, "LIBRARY", folder / kernel.LIBRARY.name)
    return folder


def load() -> object:
    return kernel.library.__wrapped__()


def test_a_copy_is_loaded(copied: Path) -> None:
    assert load()._name == str(copied / "_kernel.so")  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["gate.hpp", "kernel.cpp"])
def test_a_library_of_other_sources_is_refused(copied: Path, name: str) -> None:
    with (copied / name).open("a") as source:
        source.write("// changed\n")
    with pytest.raises(KernelError, match=r"not that of the sources beside it.*python packages/ur-core/hatch_build.py"):
        load()


def test_a_new_source_is_noticed(copied: Path) -> None:
    (copied / "more.hpp").touch()
    with pytest.raises(KernelError, match="not that of the sources beside it"):
        load()


def test_a_missing_library_is_reported(copied: Path) -> None:
    (copied / "_kernel.so").unlink()
    with pytest.raises(KernelError, match=r"_kernel\.so is missing in .*python packages/ur-core/hatch_build.py"):
        load()


def test_a_foreign_library_is_reported(copied: Path) -> None:
    (copied / "_kernel.so").unlink()  # not to be written to while it is mapped
    (copied / "_kernel.so").write_bytes(b"MZ" + bytes(1000))
    with pytest.raises(KernelError, match=r"is not for this machine: .*install the package again"):
        load()


def test_the_build_hashes_sources_as_the_package_does() -> None:
    spec = importlib.util.spec_from_file_location("hatch_build", CORE / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    assert build.sources_hash(CORE / build.KERNEL) == kernel.sources_hash()


def test_constants_keep_their_own_memory(tmp_path: Path) -> None:
    """A pickled task goes on in another process, where no former address holds."""
    file = tmp_path / "tasks"
    tasks = [EnvSetup.resolve(name, {}).make_task() for name in ("SineTracking", "SyncCarry", "Handover")]
    poses = kinematics.flange_pose(np.zeros(6), NOMINAL_DH)[0]
    file.write_bytes(pickle.dumps((tasks, Constants(poses))))
    code = (
        "import pickle, sys, numpy as np; tasks, constants = pickle.loads(open(sys.argv[1], 'rb').read())\n"
        "for task in tasks: start = task.start(np.arange(1), [np.random.default_rng(0)]); print(start.q_rad.tolist())"
    )
    done = subprocess.run([sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=True)
    expected = [task.start(np.arange(1), [np.random.default_rng(0)]).q_rad.tolist() for task in tasks]
    assert done.stdout.split("\n")[:-1] == [str(each) for each in expected]
    again = copy.deepcopy(Constants(poses))
    assert again.address != Constants(poses).address
    assert (np.ctypeslib.as_array((ctypes.c_double * 3).from_address(again.address)) == poses).all()


def test_a_link_to_another_structure_is_refused() -> None:
    envelope = Envelope(MotionLimits(), 0.008, 5).kernel
    with pytest.raises(KernelError, match=r"Gate.distances must be a Distances, found a Envelope"):
        Struct("Gate", **_gate_fields() | {"distances": envelope})


def _gate_fields() -> dict[str, object]:
    return dict(SafetyGate(MotionLimits(), 0.008, 5, AlwaysClear())._step._made_of[1].values)


def test_comments_of_the_sources_name_what_exists() -> None:
    texts = [path.read_text() for path in kernel.FOLDER.glob("*.?pp")]
    names = {name for text in texts for name in re.findall(r"`(dual_ur10(?:\.\w+)+)", text)}
    assert len(names) > 8
    for name in names:
        pkgutil.resolve_name(name)
