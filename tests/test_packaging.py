import ast
import configparser
import fnmatch
import importlib.util
import json
import pathlib
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile

import pytest
import yaml

from dual_ur10.errors import MissingExtraError
from tests.alone import built_of

ROOT = pathlib.Path(__file__).parents[1]
CORE, EMULATOR = (ROOT / "packages" / name for name in ("ur-core", "ur-emulator"))
WORKFLOWS = ROOT / ".github" / "workflows"


@pytest.fixture(params=[ROOT, CORE, EMULATOR], ids=["dual-ur10", "ur-core", "ur-emulator"])
def built(request, wheel_of):
    """Folder of a distribution, its wheel, and the names in it."""
    wheel = wheel_of(request.param)
    return request.param, wheel, zipfile.ZipFile(wheel).namelist()


def test_a_wheel_holds_its_packages_and_nothing_else(built):
    root, wheel, names = built
    rooms = {name.rsplit("/", 2)[1] for name in names if name.endswith("/__init__.py") and name.count("/") == 2}
    held = {name.split("/")[0] for name in names if ".dist-info" not in name}
    if root == ROOT:
        assert held == {"dual_ur10"}
        assert {each for each in rooms if f"dual_ur10/{each}/__init__.py" in names} == {
            "assets",
            "cli",
            "emulated",
            "envs",
            "lerobot",
            "policies",
            "sim2real",
            "tasks",
        }
        assert "dual_ur10/sim2real/analysis/templates/page.html" in names
        assert "dual_ur10/policies/learned/learned_policies/sine_tracking/policy.safetensors" in names
        assert "dual_ur10/py.typed" in names
        assert wheel.name.endswith("-py3-none-any.whl")
        return
    if root == EMULATOR:
        assert held == {"ur_emulator"}
        assert {"ur_emulator/script/grammar.lark", "ur_emulator/py.typed"} <= set(names)
        assert wheel.name.endswith("-py3-none-any.whl")
        return
    assert held == {"ur_core"}
    assert rooms == {"kernel", "kinematics", "links", "mjcf", "processes", "protocol", "tools", "viewing"}
    assert {"ur_core/mjcf/ur10.xml", "ur_core/py.typed"} <= set(names)
    # The loader compares the sources with what the library was compiled from.
    sources = {path.name for path in (root / "ur_core" / "kernel").glob("*.?pp")}
    assert {"kernel.cpp", "gate.hpp"} <= sources
    kernel = {name.removeprefix("ur_core/kernel/") for name in names if name.startswith("ur_core/kernel/")}
    assert kernel == {"__init__.py", "_kernel.so", "flags.txt"} | sources
    platform = re.sub("[-.]", "_", sysconfig.get_platform())
    assert wheel.name.endswith(f"-py3-none-{platform}.whl")  # one for all Pythons of a platform


def test_an_sdist_gives_the_same_wheel(built, tmp_path):
    root, wheel, names = built
    for name in ("sdist", "root", "wheel"):
        (tmp_path / name).mkdir()
    with tarfile.open(built_of(root, "sdist", tmp_path / "sdist")) as sdist:
        found = {name.split("/", 1)[1] for name in sdist.getnames()}
        sdist.extractall(tmp_path / "root", filter="data")
    assert "pyproject.toml" in found
    if root == ROOT:
        assert {"Makefile", "constraints.txt", "CITATION.cff", "tests/conftest.py", "docs/index.md"} <= found
    assert not [name for name in found if name.endswith((".so", ".pyc"))]
    (unpacked,) = (tmp_path / "root").iterdir()
    again, first = zipfile.ZipFile(built_of(unpacked, "wheel", tmp_path / "wheel")), zipfile.ZipFile(wheel)
    assert again.namelist() == names
    for name in names:
        if name.endswith(".so"):
            assert again.read(name) == first.read(name)


CHANGELOGS = {root: (root / "CHANGELOG.md").read_text() for root in (ROOT, CORE, EMULATOR)}
CHANGELOG = CHANGELOGS[ROOT]


def test_the_distributions_have_one_version():
    """Each needs the others in it, and each changelog begins with it, released or not."""
    import dual_ur10
    import ur_core
    import ur_emulator

    version = dual_ur10.__version__
    assert (ur_core.__version__, ur_emulator.__version__) == (version, version)
    for root in (ROOT, CORE, EMULATOR):
        project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
        needed = [
            *project["dependencies"],
            *(each for extra in project["optional-dependencies"].values() for each in extra),
        ]
        others = [each for each in needed if re.match(r"(dual-ur10|ur-core|ur-emulator)\b", each)]
        assert [
            each for each in others if not each.startswith(project["name"]) and not each.endswith(f"=={version}")
        ] == []
    first = [re.search(r"^## \[(.*?)\] - (.*)$", text, re.MULTILINE).groups() for text in CHANGELOGS.values()]
    assert first == [(version, first[0][1])] * 3


def test_plugins_have_the_names_and_the_version_that_lerobot_and_they_need():
    """LeRobot looks for the beginning of a distribution's name, which hyphens would hide from it."""
    import dual_ur10

    projects = sorted((ROOT / "integrations").glob("*/pyproject.toml"))
    assert len(projects) == 3
    for path in projects:
        project = tomllib.loads(path.read_text())["project"]
        assert re.fullmatch(r"lerobot_(robot|teleoperator|env)_dual_ur10", project["name"])
        assert (path.parent / project["name"] / "__init__.py").is_file()
        assert path.parent.name == project["name"]
        assert project["version"] == dual_ur10.__version__
        own = [each for each in project["dependencies"] if "dual" in each]
        assert [each for each in own if not each.endswith(f"=={dual_ur10.__version__}")] == []


def _step(name, job="build"):
    """Return a step of the workflow of releases by the beginning of its name or action."""
    jobs = yaml.safe_load((WORKFLOWS / "release.yml").read_text())["jobs"]
    (step,) = (each for each in jobs[job]["steps"] if (each.get("name") or each.get("uses", "")).startswith(name))
    return step


def test_a_release_has_the_tag_of_all_distributions(tmp_path):
    import dual_ur10

    files = (
        "dual_ur10/ids.py",
        *(f"packages/{name}/{name.replace('-', '_')}/__init__.py" for name in (CORE.name, EMULATOR.name)),
    )
    for odd in (None, *files):
        for file in files:
            (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
            text = (ROOT / file).read_text()
            (tmp_path / file).write_text(text.replace(dual_ur10.__version__, "9.9") if file == odd else text)
        done = subprocess.run(
            ["bash", "-e", "-c", _step("The tag")["run"]],
            cwd=tmp_path,
            env={"PATH": "/usr/bin:/bin", "GITHUB_REF_NAME": f"v{dual_ur10.__version__}"},
            timeout=20,
        )
        assert (done.returncode == 0) == (odd is None), odd


def test_a_release_publishes_all_distributions(wheel_of):
    """Sdists and wheels for any platform as `make dist` builds them; the compiled wheel for each platform."""
    patterns = _step("actions/upload-artifact")["with"]["path"].split()
    made = {root: f"out/dist/{wheel_of(root).name}" for root in (ROOT, CORE, EMULATOR)}
    found = {root for root, name in made.items() if any(fnmatch.fnmatch(name, each) for each in patterns)}
    assert found == {ROOT, EMULATOR}
    assert "out/dist/*.tar.gz" in patterns
    assert ROOT / _step("pypa/cibuildwheel", "wheels")["with"]["package-dir"] == CORE


def _metadata(repository):
    """Return the metadata of the package, and the setting it has now."""
    core = pytest.importorskip("hatchling.metadata.core")
    manager = pytest.importorskip("hatchling.plugin.manager")
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())
    hook = config["tool"]["hatch"]["metadata"]["hooks"]["custom"]
    present, hook["repository"] = hook["repository"], hook["repository"] if repository is None else repository
    return core.ProjectMetadata(str(ROOT), manager.PluginManager(), config).core, present


LINK = re.compile(r'(?:\]\(|src=")([^)"]+)')


def test_links_of_the_readme_are_absolute_where_the_repository_has_an_address():
    import dual_ur10

    at, tag = "https://example.org/team/arms", f"v{dual_ur10.__version__}"
    found, _ = _metadata(f"{at}/")
    text = (ROOT / "README.md").read_text()
    before, after = LINK.findall(text), LINK.findall(found.readme)
    assert len([each for each in before if not each.startswith("http")]) > 30
    for old, new in zip(before, after, strict=True):
        if old.startswith("http"):
            assert new == old
            continue
        kind, there = new.removeprefix(f"{at}/").split(f"/{tag}/")
        assert there == old
        assert (ROOT / there.partition("#")[0]).exists()
        assert kind == ("raw" if re.search(r"\.(webp|png)$", old) else "blob")
    assert any(new.endswith("install.md#pytorch-without-cuda") for new in after)
    assert LINK.sub("", found.readme) == LINK.sub("", text)
    assert found.urls == {
        "Repository": at,
        "Issues": f"{at}/issues",
        "Changelog": f"{at}/blob/{tag}/CHANGELOG.md",
    }
    assert found.readme_content_type == "text/markdown"


def test_links_in_code_and_within_the_page_stay():
    hook = _loaded_hook()
    text = '[a](#b) [c](d.md#e) <img src="f.png">\n```py\nx = [1](2)\n```\n[g](https://h)\n[![i](j.svg)](k/)\n'
    assert hook.with_absolute_links(text, "https://x", "1") == (
        '[a](#b) [c](https://x/blob/v1/d.md#e) <img src="https://x/raw/v1/f.png">\n```py\nx = [1](2)\n```\n'
        "[g](https://h)\n[![i](https://x/raw/v1/j.svg)](https://x/blob/v1/k/)\n"
    )


def _loaded_hook():
    specification = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_without_an_address_nothing_is_rewritten():
    found, _ = _metadata("")
    assert found.readme == (ROOT / "README.md").read_text()
    assert found.urls == {}
    assert found.dynamic == []


def test_all_addresses_and_authors_are_the_same():
    """The site's comes from the setting, too; the citation has it once there is one, as it cannot read settings."""
    found, present = _metadata(None)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation.get("repository-code", "") == present
    assert "repo_url" not in (ROOT / "mkdocs.yml").read_text()
    (author,) = citation["authors"]
    assert author["name"] == found.authors_data["name"][0]
    assert citation["license"] == found.license_expression
    assert citation["version"] == found.config["version"]
    assert {"cff-version", "message", "title", "abstract", "type", "keywords"} <= citation.keys()
    assert ("date-released" in citation) == ("[" + citation["version"] + "] - unreleased" not in CHANGELOG)


def test_the_container_installs_what_the_pages_say():
    """Nothing here can build it: that its files and extras exist, and that its packages are those of the pages."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    lines = [line.split(" ", 1) for line in text.splitlines() if line and not line.startswith("#")]
    given = {name: [rest for each, rest in lines if each == name] for name, _ in lines}
    sources = [each for rest in given["COPY"] for each in rest.split()[:-1] if not each.startswith("--")]
    assert sources
    assert [each for each in sources if not (ROOT / each).exists()] == []
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    needed = [
        "pyproject.toml",
        "hatch_build.py",
        "README.md",
        "LICENSE",
        "constraints.txt",
        "dual_ur10",
        "packages",
    ]
    assert [each for each in needed if any(fnmatch.fnmatch(each, pattern) for pattern in ignored)] == []
    assert {".git", ".venv*", "**/_kernel.*"} <= set(ignored)
    (install,) = (rest for rest in given["RUN"] if rest.startswith("pip "))
    assert "-c constraints.txt" in install
    extras = set(re.search(r'-e "\.\[(.*)\]"', install)[1].split(","))
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert extras <= known.keys()
    assert set(re.search(r'-e "\.\[(.*)\]"', (ROOT / "README.md").read_text())[1].split(",")) <= extras
    apt = set(" ".join(rest for rest in given["RUN"] if rest.startswith("apt-get")).split())
    page = (ROOT / "docs" / "how-to" / "install.md").read_text()
    assert set(re.search(r"Install Mesa's EGL: `apt-get install (.*?)`", page)[1].split()) <= apt
    assert {"make", "g++", "python3", "python3-venv"} <= apt


def test_the_packages_for_drawing_are_the_same_everywhere():
    """PyOpenGL loads libOpenGL.so.0, which none of Mesa's packages brings."""
    from dual_ur10.envs.rendering import images

    pages = ["Dockerfile", ".github/workflows/ci.yml", "docs/how-to/install.md", "docs/how-to/images-and-videos.md"]
    texts = [images._NO_GL, *((ROOT / page).read_text() for page in pages)]
    named = [{*re.findall(r"\blib[a-z0-9-]*(?:egl|gl|mesa)[a-z0-9-]*", text)} - {"libosmesa6"} for text in texts]
    assert named == [{"libegl1", "libegl-mesa0", "libgl1-mesa-dri", "libopengl0"}] * len(texts)


def test_the_dev_container_is_the_same_container():
    dev = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    file = ROOT / ".devcontainer" / dev["build"]["dockerfile"]
    assert (file.resolve(), (ROOT / ".devcontainer" / dev["build"]["context"]).resolve()) == (ROOT / "Dockerfile", ROOT)
    text = file.read_text()
    assert f"USER {dev['remoteUser']}\nWORKDIR {dev['workspaceFolder']}\n" in text
    assert f"target={dev['workspaceFolder']}," in dev["workspaceMount"]
    assert [each for each in dev["build"]["args"] if f"ARG {each}\n" not in text] == []
    assert (ROOT / dev["postCreateCommand"].removeprefix("python ")).exists()


def test_actions_of_workflows_are_pinned_by_hash():
    uses = [each for path in WORKFLOWS.glob("*.yml") for each in re.findall(r"uses: (.*)", path.read_text())]
    assert uses
    assert not [each for each in uses if not re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v\d+(\.\d+)+", each)]


CONSUMER = """
from dual_ur10 import ArmMount, CellConfig
from dual_ur10.policies import Policy, load

cell = CellConfig(left=ArmMount((-0.75, 0.6, 0.0)))
policy: Policy = load("scripted", "DualUR10/SineTracking-v0", cell=cell)
wrong: int = cell.left
"""


def test_the_types_of_the_wheels_reach_their_users(wheel_of, tmp_path):
    pytest.importorskip("mypy")
    home = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home)], check=True, timeout=120)
    (packages,) = home.glob("lib/python*/site-packages")
    for root in (ROOT, CORE, EMULATOR):
        # Alone: reading what they depend on takes a minute and shows no more.
        zipfile.ZipFile(wheel_of(root)).extractall(packages)
    consumer = tmp_path / "consumer.py"
    consumer.write_text(CONSUMER)
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(home / "bin" / "python")]
    found = subprocess.run(
        [*command, "--cache-dir", str(tmp_path / "cache"), str(consumer)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
    )
    assert re.findall(r"consumer\.py:(\d+): error: (.*)  \[assignment\]", found.stdout) == [
        ("7", 'Incompatible types in assignment (expression has type "ArmMount", variable has type "int")')
    ], found.stdout
    assert "Found 1 error in 1 file" in found.stdout


PACKAGES = {"dual_ur10": ROOT, "ur_emulator": EMULATOR, "ur_core": CORE}


def _modules():
    """Yield the modules of all packages: name and path."""
    for package, root in PACKAGES.items():
        for path in sorted((root / package).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            yield name.removesuffix(".__init__"), path


def test_every_module_stands_on_a_floor():
    """`make lint` checks the contracts; a room that none of them names would import as it likes."""
    contracts = configparser.ConfigParser()
    contracts.read(ROOT / ".importlinter")
    layers = " ".join(contracts[f"importlinter:contract:{name}"]["layers"] for name in ("floors", "core"))
    floors = [*re.split(r"[:\s]+", layers.strip()), "ur_emulator"]  # whose rooms are still one
    faces = {"dual_ur10", "dual_ur10.sim2real", "ur_core"}  # of the packages, and of a room that holds rooms
    rooms = tuple(f"{each}." for each in floors)
    unknown = [name for name, _ in _modules() if not f"{name}.".startswith(rooms) and name not in faces]
    assert unknown == []


def test_no_function_takes_an_arm_for_a_ur10():
    found = []
    for _, path in _modules():
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if re.search(r"NOMINAL_DH|(?<!dual[-_])ur10\b", text) else ():
            if isinstance(node, ast.FunctionDef):
                defaults = [each for each in (*node.args.defaults, *node.args.kw_defaults) if each is not None]
                if any(re.search(r"NOMINAL_DH|(?<!dual-)ur10\b", ast.unparse(each)) for each in defaults):
                    found.append(node.name)
    assert found == ["default_mount"]  # of the default cell, whose arms are UR10s


@pytest.mark.parametrize(("version", "words"), [((3, 12), "needs ur_rtde: pip install"), ((3, 13), "for Python 3.11")])
def test_a_package_without_wheels_for_this_python_says_so(monkeypatch, version, words):
    monkeypatch.setattr(sys, "version_info", (*version, 0))
    text = str(MissingExtraError("ur_rtde", "real", "moving UR arms"))
    assert words in text
    assert ("found 3.13" in text) == (version > (3, 12))
    assert 'pip install "dual-ur10[real]"' in text
    assert "found" not in str(MissingExtraError("matplotlib", "plot", "drawing"))
