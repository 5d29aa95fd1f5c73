"""Documentation: links, code blocks that run, commands that parse, and the table of faults."""

import ast
import contextlib
import importlib.util
import json
import pkgutil
import re
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import get_args

import pytest
import typer
import yaml

import dual_ur10.errors
import ur_core.errors
import ur_emulator.cli
from dual_ur10 import tasks
from dual_ur10.assets import visuals
from dual_ur10.assets.settings import Equipment, SceneSettings
from dual_ur10.cli.main import app
from dual_ur10.envs.core.randomization import PRESETS
from dual_ur10.ids import ENV_IDS, TASKS, env_id_of
from dual_ur10.policies.baselines import BASELINES
from dual_ur10.policies.operators.catalog import DEVICES
from dual_ur10.policies.registry import NAMES
from dual_ur10.policies.training import settings
from tests import documented_facts, scripts
from tests.cli.command import run
from ur_core.kinematics.ur10 import ARMS
from ur_emulator.profile import POLYSCOPES, PROFILES
from ur_emulator.world.plant import PLANTS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
DISTRIBUTIONS = {".": "dual-ur10", "packages/ur-core": "ur-core", "packages/ur-emulator": "ur-emulator"}
READMES = {name: ROOT / "packages" / name / "README.md" for name in ("ur-core", "ur-emulator")}
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *READMES.values(), *sorted(DOCS.rglob("*.md"))]
TASK_NAMES = "sine-tracking sync-carry handover free peg-insertion tray-balance box-lift lid-and-place"
TASK_PAGES = {f"tasks/{name}.md" for name in TASK_NAMES.split()}
GENERATED = {"reference/cli.md", "reference/cell-file.md", "reference/errors.md", "decisions/index.md", "changelog.md"}
GENERATED |= {
    "contributing.md",
    "reference/cli-ur-emulator.md",
    "changelog-ur-core.md",
    "changelog-ur-emulator.md",
    *TASK_PAGES,
}
FAULTS = 64


def page_id(path):
    return path.relative_to(ROOT).as_posix()


def blocks(path, language):
    """Yield the code blocks of a page in this language, without the indentation of lists."""
    for indent, code in re.findall(rf"^( *)```{language}\b[^\n]*\n(.*?)^ *```", path.read_text(), re.M | re.S):
        yield re.sub(rf"^{indent}", "", code, flags=re.MULTILINE)


def rows():
    """Return the number and the last column of each row of the fault table."""
    text = (DOCS / "reference" / "faults.md").read_text()
    return [(int(row), shown) for row, shown in re.findall(r"^\| (\d+) \|.*\| ([^|]*) \|$", text, re.MULTILINE)]


def test_the_fault_table_is_complete():
    assert [row for row, _ in rows()] == list(range(1, FAULTS + 1))


TESTS = (ROOT / "tests", *ROOT.glob("packages/*/tests"))


def test_the_tests_of_the_fault_table_exist():
    """Each named file exists, and one of faults has a test with the row's number in its name."""
    numbers = {}
    for path in (ROOT / "tests").glob("*/faults/test_*.py"):
        names = re.findall(r"^def test_((?:\d+_)+)", path.read_text(), re.MULTILINE)
        name = path.relative_to(ROOT / "tests").with_suffix("").as_posix()
        numbers[name] = {int(each) for found in names for each in found.split("_") if each}
    for row, shown in rows():
        named = re.findall(r"`([\w/]+)`", shown)
        assert named or shown == "—", f"row {row} names no test and does not say so"
        for name in named:
            assert any((each / f"{name}.py").is_file() for each in TESTS), f"row {row}: {name}"
            if "/faults/" in name:
                assert row in numbers[name], f"row {row}: {name} has no test of it"


@pytest.mark.parametrize("path", PAGES, ids=page_id)
def test_links_lead_somewhere(path):
    for target, anchor in re.findall(r"\]\((?!http)([^)#\s]*)#?([^)\s]*)\)", path.read_text()):
        there = (path.parent / target).resolve() if target else path
        if DOCS in there.parents and there.relative_to(DOCS).as_posix() in GENERATED:
            continue  # `make docs` checks links to generated pages
        assert there.exists(), target
        if anchor:
            titles = re.findall(r"^#+ (.*)$", there.read_text(), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in titles], anchor


ROOTS = (ROOT, *(ROOT / "packages" / name for name in READMES), *TESTS)
FOLDERS = "benchmarks|demo|docs|dual_ur10|examples|packages|tests|ur_core|ur_emulator"


@pytest.mark.parametrize("path", [*PAGES, ROOT / "SECURITY.md"], ids=page_id)
def test_paths_on_pages_exist(path):
    """Files and folders of the repository, of a package or of its tests, with or without the ending of modules."""
    named = re.findall(rf"(?<![\w/.-])((?:{FOLDERS})/[\w./-]*\w)", re.sub(r"\]\([^)]*\)", "]", path.read_text()))
    found = {each for each in named for root in ROOTS if (root / each).exists() or (root / f"{each}.py").exists()}
    assert sorted(set(named) - found) == []


def test_every_page_is_in_the_navigation():
    named = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert {each for each in pages - named if not each.startswith("decisions/")} == set()
    assert named - pages <= GENERATED


def load(name):
    """Return a module of the folder of the documentation."""
    specification = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def broken_lists(text):
    """Return the lines of a page's HTML that begin as an item of a list or a row of a table would in Markdown.

    A numbered list that comes apart would begin again at 1: it is returned, too.
    """
    markdown = pytest.importorskip("markdown")
    pytest.importorskip("pymdownx")
    configured = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["markdown_extensions"]
    settings = {name: each for entry in configured if isinstance(entry, dict) for name, each in entry.items()}
    names = [entry if isinstance(entry, str) else next(iter(entry)) for entry in configured]
    html = markdown.markdown(text, extensions=names, extension_configs=settings)
    html = re.sub(r"<pre\b.*?</pre>", "", html, flags=re.DOTALL)
    written = re.findall(r"^ *(\d+)\. ", re.sub(r"^ *```.*?^ *```", "", text, flags=re.M | re.S), re.MULTILINE)
    apart = [] if html.count("<ol>") == written.count("1") else [f"{html.count('<ol>')} numbered lists"]
    return re.findall(r"^\s*(?:<p>|<li>)*(?:(?:\d+\.|[-*+]) |\||```).*", html, re.MULTILINE) + apart


def test_every_name_of_the_facade_is_on_a_page():
    named = {
        each.split(".")[-1] for path in PAGES for each in re.findall(r"^::: (\S+)$", path.read_text(), re.MULTILINE)
    }
    assert sorted(set(tasks.__all__) - named) == []


@pytest.mark.parametrize("path", PAGES, ids=page_id)
def test_lists_and_tables_do_not_run_into_a_paragraph(path):
    """MkDocs wants what belongs to an item indented by four spaces, and an empty line before a list."""
    assert broken_lists(path.read_text()) == []


def prose(path):
    """Return the text of a page without its code blocks and the addresses of its links."""
    text = re.sub(r"^ *```.*?^ *```", "", path.read_text(), flags=re.M | re.S)
    return re.sub(r"\]\([^)]*\)", "]", text)


def words(text):
    return len(re.findall(r"\w[\w.,'/-]*", text))


TO_READ = sorted([*DOCS.glob("tutorials/*.md"), *DOCS.glob("explanation/*.md"), *DOCS.glob("how-to/*.md")])


@pytest.mark.parametrize("path", TO_READ, ids=page_id)
def test_pages_can_be_read(path):
    """At most 2,000 words a page, and a heading every 650."""
    text = prose(path)
    assert words(text) <= 2000
    sections = re.split(r"^#+ .*$", re.sub(r"^ *\|.*$", "", text, flags=re.MULTILINE), flags=re.MULTILINE)
    assert max(map(words, sections)) <= 650


@pytest.mark.parametrize("path", PAGES, ids=page_id)
def test_pictures_have_a_text(path):
    assert re.findall(r"!\[\W*\]|<(?:img|video)(?![^>]*(?:alt|aria-label)=)[^>]*>", path.read_text()) == []


@pytest.mark.parametrize("name", sorted(GENERATED))
def test_generated_lists_and_tables_do_not_run_into_a_paragraph(name):
    pytest.importorskip("mkdocs")
    assert broken_lists(load("hooks").pages(DOCS)[name]()) == []


def test_each_task_has_a_page_also_one_that_is_registered_later(monkeypatch):
    pytest.importorskip("mkdocs")
    assert load("hooks").pages(DOCS).keys() == GENERATED
    monkeypatch.setitem(TASKS, "MyLab/PegHandover-v3", TASKS["DualUR10/Handover-v0"])
    nav = load("hooks").on_config({"nav": [], "docs_dir": DOCS})["nav"]
    assert "tasks/mylab-peg-handover.md" in nav[0]["Tasks"]
    page = load("hooks").pages(DOCS)["tasks/mylab-peg-handover.md"]()
    assert page.startswith("# PegHandover\n")
    assert "python -m dual_ur10 view MyLab/PegHandover-v3 --policy learned" in page
    assert "## Baselines" not in page  # nothing was measured


@pytest.mark.parametrize("address", ["", "https://example.org/team/arms"])
def test_the_site_has_the_address_of_the_repository_once_there_is_one(address, tmp_path):
    pytest.importorskip("mkdocs")
    (tmp_path / "pyproject.toml").write_text(f"[tool.hatch.metadata.hooks.custom]\nrepository = '{address}'")
    config = load("hooks").on_config({"nav": [], "docs_dir": str(tmp_path / "docs")})
    assert (config.get("repo_url", ""), config.get("repo_name", "")) == (address, address[20:])


@pytest.mark.parametrize("name", ["handover", "free"])
def test_the_code_on_the_page_of_a_task_runs(name, monkeypatch, workplace):
    pytest.importorskip("mkdocs")
    monkeypatch.chdir(workplace)
    page = load("hooks").pages(DOCS)[f"tasks/{name}.md"]()
    written = workplace / f"{name}.md"
    written.write_text(page)
    start, change = blocks(written, "python")
    for code in (start, change) if name == "free" else (change,):
        exec(code, {})
    for line in "\n".join(blocks(written, "sh")).splitlines():
        parse(shlex.split(line)[3:])


def test_the_videos_of_tasks_are_those_of_their_commands(workplace, monkeypatch):
    """Each task of this package has a picture, each video a poster, and none is large."""
    monkeypatch.chdir(workplace)
    folder = DOCS / "media"
    entries = json.loads((folder / "media.json").read_text())
    assert {each["env_id"] for each in entries} == {*ENV_IDS}
    tree = ast.parse((DOCS / "media.py").read_text())
    named = {ast.unparse(each.targets[0]): each.value for each in tree.body if isinstance(each, ast.Assign)}
    videos = ast.literal_eval(named["VIDEOS"])
    assert {each["name"]: (each["title"], each["caption"]) for each in entries if "command" in each} == {
        name: (title, caption) for name, (_, title, caption) in videos.items()
    }
    expected = {"media.json"}
    for each in entries:
        expected.add(f"{each['name']}.webp")
        if "command" in each:
            expected.add(f"{each['name']}.mp4")
            program, *arguments = shlex.split(each["command"])
            assert program == "dual-ur10"
            parse(arguments)
            assert env_id_of(arguments[1]) == each["env_id"]
    sizes = {path.name: path.stat().st_size for path in folder.iterdir()}
    assert sizes.keys() == expected
    assert max(*sizes.values(), (DOCS / "images" / "tasks.webp").stat().st_size) < 3_000_000
    assert sum(sizes.values()) < 25_000_000


def test_intervals_of_success_are_those_of_their_counts():
    """Each row of a table with "k of n" and an interval has Wilson's."""
    checked = 0
    for path in [DOCS / "reference" / "benchmarks.md", *(ROOT / documented_facts.CARDS).rglob("card.md")]:
        for row in re.findall(r"^\|.*\d of \d.*\|$", path.read_text(), re.MULTILINE):
            found = re.search(r"\| (\d+) of (\d+) \| (?:95 % )?([\d.]+) to ([\d.]+) % \|", row)
            if found:
                k, n, z2 = int(found[1]), int(found[2]), 1.959964**2
                middle, width = k + z2 / 2, (z2 * (k * (n - k) / n + z2 / 4)) ** 0.5
                low, high = (f"{100 * (middle + each) / (n + z2):.1f}" for each in (-width, width))
                assert (found[3], found[4]) == (low, high.replace("100.0", "100")), row
                checked += 1
    assert checked > 30


def test_plots_are_those_of_their_figures_and_these_are_those_of_the_tables():
    pytest.importorskip("matplotlib")
    figures = load("figures")
    for name in figures.PLOTS:
        plot = figures.plot_of(name)
        drawn = (DOCS / "images" / f"figure_{name}.svg").read_text()
        assert figures.digest(plot) in drawn, f"run docs/figures.py: {name} was drawn of other figures"
    text = (DOCS / "reference" / "benchmarks.md").read_text()
    rows = [
        row
        for plot in json.loads((DOCS / "reference" / "benchmarks.json").read_text()).values()
        for row in plot["rows"]
    ]
    assert len(rows) == 10
    for row in rows:
        section = text.partition(f" {row['section']}\n")[2]
        line = next(line for line in section.splitlines() if line.startswith(f"| {row['row']} |"))
        stated = {float(each) for each in re.findall(r"(?<![\d.])\d+(?:\.\d+)?", line)}
        assert {float(each) for each in row.values() if not isinstance(each, str)} <= stated, row


def test_the_picture_of_the_distributions_is_that_of_the_contracts():
    """It holds a hash of them, and the page names every room."""
    pytest.importorskip("matplotlib")
    floors = load("floors")
    shown = floors.contracts()
    assert shown.digest() in floors.PICTURE.read_text(), "run docs/floors.py: the contracts are others"
    page = (DOCS / "explanation" / "architecture.md").read_text()
    named = {each.rpartition("/")[2] for each in re.findall(r"`([\w/]+)`", page)}
    for package, rows in shown.floors.items():
        (folder,) = (each for each in (ROOT / package, *ROOT.glob(f"packages/*/{package}")) if each.is_dir())
        for room in (room for row in rows for room in row):
            path = room.replace(".", "/")
            assert path.rpartition("/")[2] in named or (folder / f"{path}.py").is_file(), room


def test_every_error_is_on_its_page():
    pytest.importorskip("mkdocs")
    listed = re.findall(r"^ *- \*\*`(\w+)`", load("hooks").errors(), re.MULTILINE)
    kinds = {
        name
        for module in (dual_ur10.errors, ur_core.errors)
        for name, each in vars(module).items()
        if isinstance(each, type) and issubclass(each, ur_core.errors.URError) and each.__name__ == name
    }
    assert sorted(listed) == sorted(kinds)


def test_only_short_keys_of_tables_stay_in_one_line():
    """A long code that did not wrap would take the width of the other columns."""
    pytest.importorskip("mkdocs")
    module = load("hooks")
    short, long = "k" * module.KEY_LENGTH, "k" * (module.KEY_LENGTH + 1)
    row = "<tr><td><code>{}</code></td></tr>"
    marked = module.on_page_content(row.format(short) + row.format(long))
    assert marked == row.format(short).replace("<code>", '<code class="key">') + row.format(long)
    assert module.on_page_content(row.format("tests/of/some_room/test_name")).count("<wbr>") == 5
    assert "Start<wbr>Error" in module.on_page_content(row.format("StartError"))
    assert module.on_page_content("<td>12-17</td>") == "<td>12\N{NON-BREAKING HYPHEN}17</td>"
    rules = re.findall(r"^([^{]*){[^}]*nowrap", (DOCS / "assets" / "extra.css").read_text(), re.MULTILINE)
    assert [each.split()[-1] for each in rules] == ["code.key"]


def test_code_wraps_and_nothing_is_drawn_in_it():
    """A line that ends behind the edge of the page would not be read; a drawing that wraps is none."""
    style = (DOCS / "assets" / "extra.css").read_text()
    assert re.search(r"^\.md-typeset pre > code {[^}]*white-space: pre-wrap", style, re.MULTILINE)
    for path in PAGES:
        for code in re.findall(r"^ *```.*\n(.*?)^ *```", path.read_text(), re.M | re.S):
            assert not re.search("[─▶│]", code), path


def test_pages_state_the_facts_of_their_sources():
    """Figures are those of the benchmarks and of the policies' cards, constants and sizes those of the code."""
    facts = documented_facts.measured() | documented_facts.constants()
    pages = {page: " ".join((ROOT / page).read_text().split()) for page, _ in documented_facts.STATEMENTS}
    stated = [(page, sentence.format_map(facts).strip()) for page, sentence in documented_facts.STATEMENTS]
    missing = [f"{page} should state: {sentence}" for page, sentence in stated if sentence not in pages[page]]
    assert not missing, "\n".join(missing)


def test_sizes_of_observations_are_those_of_the_spaces():
    kinds = ("_both", "_arm", "_agent", "_adds")
    sizes = {value for name, value in documented_facts.constants().items() if name.endswith(kinds)}
    for path in [*PAGES, ROOT / "CHANGELOG.md"]:
        assert set(re.findall(r"\b(\d+) numbers\b", path.read_text())) <= sizes, path


def test_the_page_of_own_tasks_shows_the_example():
    """Its first block is the class of the example, to the letter."""
    assert next(blocks(DOCS / "how-to" / "own-task.md", "python")) in (ROOT / "examples" / "own_task.py").read_text()


def test_the_starts_for_learners_are_what_the_example_runs():
    """The README's settings, keywords, cells and steps of PPO are those whose curves and figures are stated."""
    example = ast.parse((ROOT / "examples" / "train_with_sb3.py").read_text())
    targets = {ast.unparse(each.targets[0]): each.value for each in example.body if isinstance(each, ast.Assign)}
    targets |= {each.target.id: each.value for each in example.body if isinstance(each, ast.AnnAssign)}
    recipes = zip(targets["RECIPES"].keys, targets["RECIPES"].values, strict=True)
    found = {name.value: {each.arg: each.value for each in call.keywords} for name, call in recipes}
    sine, lift = (code for code in blocks(ROOT / "README.md", "python") if "PPO(" in code)
    named, keywords = _start(sine)
    assert named["entries"] == _texts(targets["SETTINGS"])["PPO"]
    assert (named["env"], named["task"], named["cells"]) == ("JointVecEnv", "'SineTracking'", "64")
    assert keywords == _texts(found["SineTracking"]["keywords"]) | _short(found["SineTracking"])
    assert _texts(targets["CELLS"])["PPO"] == "64"
    assert named["steps"] == _texts(found["SineTracking"]["steps"])["PPO"]
    named, keywords = _start(lift)
    assert named["entries"] == _texts(targets["OBJECTS_SETTINGS"])["PPO"]
    assert (named["env"], named["task"], named["cells"]) == ("TwoAgentVecEnv", "'Handover'", "64")
    assert keywords == _texts(found["lift"]["keywords"]) | _short(found["lift"]) | {"reward": "'individual'"}
    assert named["steps"] == f"2 * {_texts(found['lift']['steps'])['PPO']}"


def _short(recipe):
    return {"max_episode_steps": ast.unparse(recipe["short"])}


def _start(code):
    """Return settings, cells and steps of a start for learners, and the keywords of its environment."""
    assert len(code.strip().splitlines()) <= 16
    told, seen, entries = ast.parse(code), {}, {}
    for node in told.body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict):
            (entries if node.targets[0].id == "settings" else seen).update(_texts(node.value))
    calls = {ast.unparse(node.func): node for node in ast.walk(told) if isinstance(node, ast.Call)}
    (env,) = (name for name in calls if name.endswith("VecEnv"))
    given = {
        name: {each.arg: ast.unparse(each.value) for each in node.keywords if each.arg} for name, node in calls.items()
    }
    entries |= given["PPO"]
    assert entries.pop("verbose") == "1"
    assert len(entries) <= 5
    task, cells = map(ast.unparse, calls[env].args)
    (steps,) = map(ast.unparse, calls["model.learn"].args)
    return {"env": env, "task": task, "cells": cells, "entries": entries, "steps": steps}, seen | given[env]


def _texts(node):
    """Return a dict of the syntax tree, with the text of each value but those that are dicts of settings."""
    found = {ast.literal_eval(key): value for key, value in zip(node.keys, node.values, strict=True) if key}
    return {
        name: _texts(value) if isinstance(value, ast.Dict) and name.isupper() else ast.unparse(value)
        for name, value in found.items()
    }


def test_every_extra_of_users_is_in_the_table_of_extras():
    """Those of each distribution are on the page of installation, those of a package in its README, too."""
    page = (DOCS / "how-to" / "install.md").read_text()
    for place, name in DISTRIBUTIONS.items():
        project = tomllib.loads((ROOT / place / "pyproject.toml").read_text())["project"]
        extras = project["optional-dependencies"].keys() - {"test", "fuzz", "docs", "dev"}
        for text in (page, READMES[name].read_text()) if name in READMES else (page,):
            assert sorted(re.findall(rf"^\| `{name}\[(\w+)\]`", text, re.MULTILINE)) == sorted(extras), name


UNRELEASED = "unreleased" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize("path", PAGES, ids=page_id)
def test_installations_work_before_the_first_release(path):
    """Blocks install a checkout, and a comment names the command for later; in a workflow the comment stands behind."""
    for block in blocks(path, "(?:sh|yaml)"):
        lines = block.splitlines()
        for before, line in zip(["", *lines], lines, strict=False):
            if "pip install" not in line or line.lstrip().startswith("#"):
                continue
            words = shlex.split(line, comments=True)
            places = [words[place + 1] for place, word in enumerate(words) if word == "-e"]
            if places:
                package = DISTRIBUTIONS[places[-1].partition("[")[0]] + "".join(re.findall(r"\[.*\]", places[-1]))
                package = f'"{package}"' if "[" in package else package
                others = [word for word in words if word not in ("-e", *places)]
                later = " ".join(["pip install", package, *others[others.index("install") + 1 :]])
                later = re.sub(r" -c \S+", "", later)
                assert before.endswith(f"After the first release: {later}") == UNRELEASED, line
            elif any(each in line for each in DISTRIBUTIONS.values()):
                assert line.endswith("# after the first release") == UNRELEASED, line


CHANGELOGS = [ROOT / "CHANGELOG.md", *sorted(ROOT.glob("packages/*/CHANGELOG.md"))]


@pytest.mark.parametrize("path", CHANGELOGS, ids=page_id)
def test_a_first_release_describes_itself(path):
    """Before the first release there is nothing that could have changed."""
    text = path.read_text()
    if text.count("\n## ") == 1:
        comparing = r".*\b(?:changed|no longer|any more|now|previously|earlier|made again)\b.*|.* before\).*"
        assert re.findall(comparing, text) == []


def test_the_readmes_of_packages_stand_alone():
    """A package index shows them without this repository; the emulator's page has the same code."""
    for path in READMES.values():
        assert re.findall(r"\]\((?!http)|(?:src|href)=", path.read_text()) == [], path
    assert [*blocks(READMES["ur-emulator"], "python")] == [*blocks(DOCS / "emulator.md", "python")]


@pytest.mark.parametrize("path", PAGES, ids=page_id)
def test_no_two_headings_of_a_page_are_the_same(path):
    titles = re.findall(r"^#+ (.*)$", re.sub(r"^ *```.*?^ *```", "", path.read_text(), flags=re.M | re.S), re.MULTILINE)
    assert sorted(set(titles)) == sorted(titles)


def test_the_fixtures_for_tests_of_users_are_named():
    fixtures = re.findall(r"@pytest.fixture\s+def (\w+)", (ROOT / "dual_ur10" / "testing.py").read_text())
    assert len(fixtures) == 2
    for page in ("explanation/architecture.md", "how-to/policy-in-ci.md"):
        assert " and ".join(f"`{each}`" for each in sorted(fixtures, reverse=True)) in (DOCS / page).read_text(), page


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """Return a folder with the cell file and the recorded run that the pages name."""
    folder = tmp_path_factory.mktemp("pages")
    new = ["cell", "new", "lab.toml", "--left", "192.168.10.11", "--right", "192.168.10.12"]
    roll = ["rollout", "SineTracking", "--episodes", "1", "--set", "duration_s=1.0", "--record", "runs"]
    with contextlib.chdir(folder):
        for command in (new, roll):
            code, text = run(*command)
            assert code == 0, text
    (recorded,) = (folder / "runs").iterdir()
    shutil.move(recorded, folder / "runs" / "20260131T120000-SineTracking-v0-mujoco")
    return folder


PYTHON = [path for path in PAGES if any(blocks(path, "python"))]


@pytest.mark.parametrize("path", PYTHON, ids=page_id)
def test_python_blocks_run(path, workplace, tmp_path):
    code = re.sub(r"\.learn\([\d_ *]+", ".learn(1024", "\n".join(blocks(path, "python")))
    if "stable_baselines3" in code:
        pytest.importorskip("stable_baselines3")
    if "dm_control" in code:
        pytest.importorskip("dm_control", reason="it has no wheels for Python 3.13")
    if any(each in code for each in ("EmulatedCell(", "emulated_cell", "EmulatedController(")):
        ast.parse(code)  # tests in real time run these, test_testing.py of the emulator and the suite
        return
    script = tmp_path / "page.py"
    script.write_text(code)
    datasets = str(workplace / "datasets")
    scripts.run(script, folder=workplace, output=tmp_path / "output", MINARI_DATASETS_PATH=datasets)


SHELL = [path for path in PAGES if any(blocks(path, "(?:sh|yaml)"))]


def parse(arguments):
    """Parse arguments of the command line, down to the command, each level with its options."""
    here, context = typer.main.get_command(app), None
    while arguments:
        context = here.make_context(here.name or "dual-ur10", list(arguments), parent=context)
        if not hasattr(here, "resolve_command"):
            break
        arguments = [*context._protected_args, *context.args]
        _, here, arguments = here.resolve_command(context, arguments)
        arguments = arguments or [""]
        if arguments == [""]:
            here.make_context(here.name, [], parent=context)
            break


def test_every_command_has_an_example_that_parses(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    for name, command in commands():
        example = command.epilog or ""
        assert re.match(rf"Example: dual-ur10 ((cell|export|import) )?{name}\b", example), name
        parse(shlex.split(example)[2:])
    emulator = typer.main.get_command(ur_emulator.cli.app)
    emulator.make_context("ur-emulator", shlex.split(emulator.epilog)[2:])


@pytest.mark.parametrize("path", SHELL, ids=page_id)
def test_commands_parse(path, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for line in "\n".join(blocks(path, "(?:sh|yaml)")).splitlines():
        words = shlex.split(line.removeprefix("        run: ").removeprefix("  run: ").strip(), comments=True)
        if words[:1] == ["make"]:
            assert words[1] in targets, line
        if words[:1] == ["ur-emulator"]:
            typer.main.get_command(ur_emulator.cli.app).make_context("ur-emulator", words[1:])
        if words[:3] == ["python", "-m", "dual_ur10"] or words[:1] == ["dual-ur10"]:
            parse(words[3 if words[0] == "python" else 1 :])


def _code():
    """Return the code of both packages, with its texts in one piece each."""
    paths = [path for package in ("dual_ur10", "packages") for path in (ROOT / package).rglob("*.py")]
    code = "\n".join(path.read_text() for path in paths)
    return re.sub(r'"\s*f?"', "", code)


def _is_said(piece, texts):
    """Return True if a text of the code has the piece, as it is or after an inserted value that ends with its start."""
    spaces = [i for i, sign in enumerate(piece) if sign == " "]
    return piece in texts or any(piece[:i] in texts and "}" + piece[i:] in texts for i in spaces)


VALUES = r"\.\.\.|\b[A-Z]+\b|\d[\dx.]*\b(?! [a-z])|[():]|\brad\b|\bleft\b|\bur_rtde\b"
"""Parts of a quoted text that code inserts: "...", names, and examples of values at an end. A number amid words is
no example, for another case would have another one."""


@pytest.mark.parametrize("name", ["how-to/troubleshooting", "reference/stops"])
def test_quoted_texts_are_those_of_the_code(name):
    """Each piece of two words or more between inserted values is part of a text in the package."""
    texts = _code()
    page = (DOCS / f"{name}.md").read_text()
    cells = re.findall(r"^\| ([^|]*`[^|]*) \|", page, re.MULTILINE)
    quoted = [text for cell in cells for text in re.findall(r"`([^`]+)`", cell)]
    pieces = {piece.strip(" ,;.") for text in quoted for piece in re.split(VALUES, text)}
    assert len(pieces) > 20
    assert {piece for piece in pieces if " " in piece and not _is_said(piece, texts)} == set()


def commands():
    """Yield the names of all commands with the commands, without groups of them."""
    pending = [typer.main.get_command(app)]
    while pending:
        command = pending.pop()
        within = getattr(command, "commands", {})
        pending += within.values()
        if not within:
            yield command.name, command


def options():
    """Yield the commands of the command line with their options by name."""
    for name, command in commands():
        yield name, {each: param for param in command.params for each in param.opts}


def test_only_commands_with_an_environment_speak_of_episodes():
    for command, its in options():
        if "--seed" in its and "episode" in its["--seed"].help:
            assert "env" in its, command


def test_the_help_names_all_presets():
    """An option that takes one of a few names has them all in its help."""
    cameras = visuals.cameras(SceneSettings(equipment=Equipment(grippers=True)))
    wanted = {
        ("rollout", "live", "view", "evaluate", "video", "collect"): {"--policy": (*NAMES, *BASELINES)},
        ("rollout", "evaluate", "collect"): {"--operator": DEVICES},
        ("evaluate", "video", "train", "collect"): {"--randomization": PRESETS},
        ("video", "live", "view"): {"--cameras": cameras},
        ("rollout", "evaluate", "live", "collect", "replay", "teach"): {"--arm": ARMS},
        ("train",): {"--algo": get_args(settings.Algorithm), "--agents": get_args(settings.AgentsKind)},
        ("emulate",): {"--plant": PLANTS, "--polyscope": POLYSCOPES, "--family": PROFILES},
        ("doctor", "new"): {"--family": PROFILES},
        ("calibrate",): {"--record": ("touch", "bar")},
    }
    found = dict(options())
    for commands_of, names in wanted.items():
        for command in commands_of:
            for option, presets in names.items():
                told = re.findall(r"[\w./-]*\w", found[command][option].help)
                assert {*presets} <= {*told}, (command, option)


def test_the_default_networks_are_those_of_the_settings():
    by_algorithm = {
        algorithm: {settings.defaults(env_id, algorithm).agents for env_id in ENV_IDS if TASKS[env_id].training}
        for algorithm in get_args(settings.Algorithm)
    }
    ((joint,), (shared,)) = by_algorithm["dagger"], by_algorithm["ppo"]
    assert by_algorithm == {"ppo": {shared}, "sac": {shared}, "bc": {joint}, "dagger": {joint}, "act": {joint}}
    told = dict(options())["train"]["--agents"].help
    assert f"Default: {joint}; of ppo and sac without --init: {shared}." in told
    table = (DOCS / "tutorials" / "train.md").read_text()
    assert f"| `{joint}` (default of `dagger`, `bc` and `--init`) |" in table
    assert f"| `{shared}` (default of `ppo` and `sac`) |" in table


EARLIER = DOCS / "explanation" / "earlier-systems.md"


def _names_of_earlier_systems():
    """Yield the code spans of the column that names where a feature lives."""
    for row in re.findall(r"^\| [^|]+ \| ([^|]*`[^|]*) \|", EARLIER.read_text(), re.MULTILINE):
        yield from re.findall(r"`([^`]+)`(?: of `([^`]+)`)?", row)


@pytest.mark.parametrize(("name", "of"), sorted(set(_names_of_earlier_systems())))
def test_what_replaces_earlier_systems_exists(name, of):
    """A command, an option of one, a target of `make`, or an object of the package."""
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    if name.startswith(("dual_ur10.", "ur_core.", "ur_emulator.")):
        pkgutil.resolve_name(name)
    elif name.startswith("make "):
        assert name.removeprefix("make ") in targets
    else:
        here = typer.main.get_command(app)
        for word in (of or name).removeprefix("python -m dual_ur10").split():
            here = here.commands[word]
        if of:
            assert name in {option for each in here.params for option in each.opts}
