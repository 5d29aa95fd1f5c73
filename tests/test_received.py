"""Data that were received: records, checkpoints and datasets import no module that they name."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import json
import random
import re
import sys
import types
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from dual_ur10.assets.prop import Prop
from dual_ur10.assets.scene import compose
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import CheckpointError, DeviceAbsentError, DualUR10Error, RecordingError, SettingsError
from dual_ur10.ids import env_id_of, received
from dual_ur10.policies.evaluation.minari_export import _core
from dual_ur10.policies.learned.checkpoint import _check, save
from dual_ur10.policies.learned.manifest import parse
from dual_ur10.policies.learned.signature import view_of, view_of_signature
from dual_ur10.policies.operators.catalog import make_device
from dual_ur10.policies.training import dataset
from dual_ur10.sim2real.analysis.reconstruction import keywords_of
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.recording.header import from_metadata, plain, to_metadata
from dual_ur10.sim2real.recording.run import Header
from tests.cli.command import run
from tests.fuzz.seeds import SEEDS
from tests.policies.learned.checkpoints import HANDOVER, leaves, parts, sealed
from tests.sim2real.recording.runs import header as _header
from tests.soak import scaled
from ur_core.objects import load_object
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85

FREE = "DualUR10/Free-v0"
NO_GRIPPER, GRIPPER = 'kind = "none"', 'kind = "robotiq"\ntool = "robotiq_2f85"'
CELL_FILE = max((each.decode() for each in SEEDS["cell_file"] if b"emulated" in each), key=len)
CELL_FILE = re.sub("  # .*", "", CELL_FILE).replace(NO_GRIPPER, GRIPPER)
POST = '<mujoco><worldbody><body><geom type="sphere" size="0.02"/></body></worldbody></mujoco>'
OWN = dataclasses.replace(ROBOTIQ_2F85, name="own", drivers=("my_lab.grippers:Link",), visuals=f"{__name__}:draw")


def header(**changes: Any) -> Header:
    made: Header = _header(**changes)  # type: ignore[no-untyped-call]
    return made


def draw(arm: Any, tool: Any) -> None:
    raise AssertionError("a record may not name a function")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the list of hostile modules that something tries to import."""
    found: list[str] = []

    class Finder:
        @staticmethod
        def find_spec(name: str, path: object = None, target: object = None) -> None:
            if name.startswith("hostile"):
                found.append(name)

    monkeypatch.setattr(sys, "meta_path", [Finder, *sys.meta_path])
    return found


def hostile(chance: random.Random) -> Any:
    name = f"hostile_{chance.randrange(10**6)}{chance.choice(['', '.part'])}"
    text = f"{name}:{chance.choice(['X', 'Lab/Task-v0', 'Task'])}"
    return chance.choice([text, [text], [text, text], {"visuals": text}, [{"name": "a", "mjcf": text}, text]])


def spoiled(value: Any, chance: random.Random, always: list[tuple[Any, ...]]) -> Any:
    """Return JSON with hostile names in a place that usually holds one, and up to two others."""
    value = copy.deepcopy(value)
    for _ in range(chance.randint(1, 3)):
        path = chance.choice(always) if chance.random() < 0.7 else chance.choice([*leaves(value)][1:])
        place = value
        with contextlib.suppress(LookupError, TypeError):  # an earlier one has taken its place
            for key in path[:-1]:
                place = place[key]
            place[path[-1]] = hostile(chance)
    return value


def records() -> tuple[dict[str, Any], dict[str, Any]]:
    cell = {"tools": [plain(OWN), plain(ROBOTIQ_2F85)], "equipment": {"tools": ["robotiq_2f85"] * 2}}
    keywords = {"objects": ["block"], "grip_force_n": 50.0, "cell": cell}
    simulated = header(env_id=FREE, source="mujoco", cell_file=None, kwargs=keywords)
    emulated = header(env_id=FREE, kwargs={"objects": []}, cell_file=CELL_FILE)
    return dataclasses.asdict(simulated), dataclasses.asdict(emulated)


def test_records_import_no_module_that_they_name(asked: list[str]) -> None:
    chance, made = random.Random(0), 0
    simulated, emulated = records()
    ways = [("kwargs", "objects"), ("kwargs", "cell", "tools"), ("kwargs", "cell", "tools", 0, "visuals"), ("env_id",)]
    texts = re.findall('(?m)^.* = ".*"$', CELL_FILE)
    for number in range(scaled(4000)):
        value = spoiled(simulated, chance, ways)
        if number % 2:
            text = chance.choice(texts)
            file = CELL_FILE.replace(text, f'{text.split(" = ")[0]} = "hostile_{number}:X"', 1)
            value = spoiled({**emulated, "cell_file": file}, chance, [("cell_sha256",), ("kwargs", "objects")])
        try:
            found = from_metadata(to_metadata(header(**value)))
            if number % 10 == 0:
                _core(found)
            compose(EnvSetup.resolve(found.env_id, keywords_of(found)).config.scene)
            made += 1
        except (DualUR10Error, TypeError, ValueError):
            continue
    assert not asked
    assert made > 5  # the visuals of a tool do not count


def test_checkpoints_and_datasets_import_no_module_that_they_name(asked: list[str]) -> None:
    chance, accepted = random.Random(1), 0
    ways = [("signature", "robot", "tools"), ("signature", "kwargs", "objects"), ("signature", "env_id")]
    views = {each: view_of(each, {}) for each in (FREE, HANDOVER)}
    manifests = [json.loads(parts(each)[1].text()) for each in views]
    for number in range(scaled(4000)):
        try:
            manifest = parse(sealed(spoiled(manifests[number % 2], chance, ways)))
            accepted += 1
        except CheckpointError:
            continue
        with contextlib.suppress(DualUR10Error):
            view_of_signature(manifest.signature)
        with contextlib.suppress(DualUR10Error):
            _check(Path("it"), manifest, views[manifest.signature.env_id])
    spec = json.loads(gym.spec(FREE).to_json())
    spec["kwargs"] |= {"objects": ["block"], "cell": "mujoco"}
    for _ in range(50):
        text = json.dumps(spoiled(spec, chance, [("id",), ("kwargs", "objects"), ("kwargs", "cell")]))
        with pytest.raises(DualUR10Error):
            dataset._check("lab/it-v0", text, views[HANDOVER])
    assert not asked
    assert accepted > 20


def test_commands_import_no_module_that_what_they_read_names(
    tmp_path: Path, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:  # the program that made it knows the module
        module = types.ModuleType("hostile_posts")
        module.POST = Prop(name="post", mjcf=POST)  # type: ignore[attr-defined]
        patch.setitem(sys.modules, module.__name__, module)
        made = ["--episodes", "1", "--set", "max_episode_steps=3", "--set", 'objects=["hostile_posts:POST"]']
        assert run("rollout", "Free", "--policy", "zero", *made, "--record", str(tmp_path))[0] == 0
        networks, manifest = parts(FREE, objects=["hostile_posts:POST"])
    (recorded,) = tmp_path.iterdir()
    save(tmp_path / "checkpoint", networks, manifest)
    for arguments in (("replay", str(recorded), "--cell", "virtual"), ("serve", str(tmp_path / "checkpoint"))):
        code, text = run(*arguments)
        assert code == 2
        assert "hostile_posts" in text
        assert "nothing is imported" in text
    assert not asked


def test_what_is_imported_or_registered_may_be_named(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = header(env_id=FREE, source="mujoco", cell_file=None, kwargs={"objects": ["my_posts:POST"]})
    with pytest.raises(RecordingError, match="named by the recording, and nothing is imported"):
        keywords_of(recorded)
    module = types.ModuleType("my_posts")
    module.POST = Prop(name="post", mjcf=POST)  # type: ignore[attr-defined]
    module.__getattr__ = lambda name: pytest.fail(name)  # type: ignore[method-assign]
    monkeypatch.setitem(sys.modules, "my_posts", module)
    assert keywords_of(recorded)["objects"] == ("my_posts:POST",)
    with received("a file"), pytest.raises(SettingsError, match="cannot be imported: 'OTHER'"):
        load_object("my_posts:OTHER", "it")
    with received("a file"), pytest.raises(SettingsError, match="to register 'A/B-v0', is named by a file"):
        env_id_of("no_such_module:A/B-v0")


def test_a_recorded_number_that_no_float_holds_is_refused() -> None:
    recorded = header(env_id=HANDOVER, source="mujoco", cell_file=None, kwargs={"object_range_m": 10**400})
    with pytest.raises(RecordingError, match="too large"):
        keywords_of(recorded)


def test_nothing_is_called_that_received_data_name(tmp_path: Any) -> None:
    """Such as the operator of a training that is resumed: the standard library is imported already."""
    file = tmp_path / "file"
    for text in (f"subprocess:Popen:args=touch {file},shell=true", f"os:mkdir:path={file}", "os:getcwd"):
        with received("the training"), pytest.raises(SettingsError, match="nothing is called for what was received"):
            make_device(text)
    assert not file.exists()
    with received("the training"), pytest.raises(DeviceAbsentError):
        make_device("keyboard")  # registered; the standard input is no terminal


def test_a_cell_file_that_was_recorded_names_registered_tools(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_tools.py").write_text("from ur_core.tools.generic_140 import GENERIC_140 as TOOL\n")
    monkeypatch.syspath_prepend(tmp_path)
    text = CELL_FILE.replace(GRIPPER, GRIPPER.replace("robotiq_2f85", "my_tools:TOOL"))
    with pytest.raises(RecordingError, match="my_tools:TOOL', is named by the recording"):
        keywords_of(header(cell_file=text))
    (tmp_path / "lab.toml").write_text(text)
    (tool, _) = load_cell_file(tmp_path / "lab.toml").config().equipment.tools
    assert tool.name == "generic_140"
    assert keywords_of(header(cell_file=text))["cell"].tools[0].name == "generic_140"
    del sys.modules["my_tools"]


def test_a_recorded_tool_is_drawn_as_the_registered_one_of_its_name() -> None:
    simulated, _ = records()
    own, registered = keywords_of(header(**simulated))["cell"].tools
    assert own == dataclasses.replace(OWN, visuals="")
    assert registered == ROBOTIQ_2F85
