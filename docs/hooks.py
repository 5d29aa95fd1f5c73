"""Pages, tables and navigation that MkDocs generates: tasks, command line, cell file, errors, robots, decisions."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import json
import re
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files


def command_line(program: str) -> str:
    """Return the reference of all commands and options of a program, as its command line declares them."""
    import typer
    from typer.cli import get_docs_for_click

    import dual_ur10.cli.main
    import ur_emulator.cli

    apps = {"dual-ur10": dual_ur10.cli.main.app, "ur-emulator": ur_emulator.cli.app}
    titles = {"dual-ur10": "Command line", "ur-emulator": "The command ur-emulator"}
    command = typer.main.get_command(apps[program])
    context = typer.Context(command, info_name=program)
    text = get_docs_for_click(obj=command, ctx=context, name=program, title=titles[program])
    text = re.sub(r"^Example: (.*)$", r"Example: `\1`", text, flags=re.MULTILINE)
    return re.sub(r"\[/?(?:bold|cyan|dim|red|yellow|green)[^\]]*\]|\[/\]", "", text)


def cell_file() -> str:
    """Return the reference of all keys of a cell file."""
    from dual_ur10.sim2real.cell_file.reference import reference_page

    return reference_page()


def errors() -> str:
    """Return the tree of exceptions with the condition of each."""
    import dual_ur10.errors
    import ur_core.errors

    modules = (ur_core.errors.__name__, dual_ur10.errors.__name__)
    lines = [
        "# Errors",
        "",
        "Every error of the three distributions is a `URError`. Its message names what was found, what is allowed and "
        "what to do. `ur_core.errors` has those of arms, links and installations; `dual_ur10.errors` has the others, "
        "and `URError` under the name `DualUR10Error`.",
        "",
    ]

    def branch(kind: type, depth: int) -> None:
        summary = inspect.getdoc(kind) or ""
        bases = [each.__name__ for each in kind.__bases__ if each.__module__ == "builtins" and each is not Exception]
        also = f" (also a `{'`, `'.join(bases)}`)" if bases else ""
        lines.append(f"{'    ' * depth}- **`{kind.__name__}`**{also}: " + " ".join(summary.split("\n\n")[0].split()))
        for each in kind.__subclasses__():
            if each.__module__ in modules:
                branch(each, depth + 1)

    branch(ur_core.errors.URError, 0)
    return "\n".join(lines) + "\n"


def robots() -> str:
    """Return the table of all models of arms."""
    from ur_core.kinematics.robots import ROBOTS

    shapes = [("model", "name", "family", "reach (m)", "payload (kg)", "d1, a2, a3, d4, d5, d6 (m)")]
    loads = [("model", "links (kg)", "speed (°/s)", "torque (N·m)", "inertia tensors", "speed and torque")]
    for name, model in ROBOTS.items():
        tensors = "published" if model.inertia_from is None else f"estimated from {ROBOTS[model.inertia_from].title}"
        limits = "published" if model.limits_from is None else f"those of {ROBOTS[model.limits_from].title}"
        rows = (model.lengths_m, model.mass_kg, model.joint_speed_deg_s, model.joint_torque_nm)
        lengths, masses, speeds, torques = (", ".join(f"{each:g}" for each in row) for row in rows)
        shapes.append((model.title, f"`{name}`", model.family, f"{model.reach_m:g}", f"{model.payload_kg:g}", lengths))
        loads.append((model.title, masses, speeds, torques, tensors, limits))
    return f"{_table(shapes)}\n\n{_table(loads)}"


LEARNERS = {
    "script": "`scripted`",
    "dagger": "`learned`, by DAgger",
    "bc": "cloning of {demonstrations} episodes",
    "act": "ACT from {demonstrations} episodes",
    "ppo": "stock PPO",
}
"""Policies of the baselines, by the names of `benchmarks/baselines.py`."""


def baselines() -> str:
    """Return the table of the baselines of all tasks."""
    rows = [("task", *_BASELINES)]
    for task, found in _measured().items():
        for number, row in enumerate(_baseline_rows(found)):
            rows.append(
                (f"[{task.partition('-v')[0]}](../tasks/{slug('DualUR10/' + task)}.md)" if number == 0 else "", *row)
            )
    return _table(rows)


def agreement() -> str:
    """Return the table of policies in simulation and on virtual cells, and the agreement of the two."""
    from dual_ur10.policies.evaluation.agreement import agreements, read_policies

    rows = [("task", "policy", "in simulation", "on virtual cells")]
    figures = [("task", "policies", "Pearson's r", "Spearman's rank correlation", "mean maximum rank violation")]
    notes = []
    for found in agreements(read_policies(Path(__file__).parent / "reference" / "agreement.csv")):
        for number, each in enumerate(found.policies):
            counts = (_counted(side.successes, side.episodes) for side in (each.simulation, each.cell))
            rows.append((found.task if number == 0 else "", each.policy, *counts))
        both = ("none" if each is None else f"{each:.2f}" for each in (found.pearson, found.spearman))
        figures.append((found.task, str(len(found.policies)), *both, f"{found.max_rank_violation:.3f}"))
        notes += [f"{found.task}: {each}." for each in found.notes]
    return "\n\n".join([_table(rows), _table(figures), *notes])


def ladder() -> str:
    """Return the table of learners on the rungs of the ladder."""
    found: dict[str, Any] = json.loads((Path(__file__).parent / "reference" / "ladder.json").read_text())
    rows = [("rung, learner", "success, %, by seed", "thousand steps", "minutes")]
    for rung, learners in found.items():
        for learner, row in learners.items():
            percents = ", ".join(f"{100 * each / row['of']:.0f}" for each in row["successes"])
            minutes = ", ".join(f"{each:.0f}" for each in row["minutes"])
            label = f"{rung.replace('-v0', '').replace('/', ', ')}: {learner.upper()}"
            rows.append((label, percents, f"{row['steps'] / 1000:,.0f}", minutes))
    return _table(rows)


_BASELINES = ("policy", "nominal", "mild", "wide", "learned from")


def _measured() -> dict[str, Any]:
    path = Path(__file__).parent / "reference" / "baselines.json"
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def _baseline_rows(found: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return a row for each learner of a task."""
    rows = []
    for name, row in found.items():
        counts = (_counted(*row[preset]) for preset in ("nominal", "mild", "wide"))
        rows.append((LEARNERS[name].format(**row), *counts, f"{row['steps']:,} steps" if "steps" in row else "–"))
    return rows


def _counted(successes: int, episodes: int) -> str:
    """Return a number of successes, with the interval of their rate."""
    from dual_ur10.policies.evaluation.results import wilson_interval

    low, high = wilson_interval(successes, episodes)
    percent = f"{100 * low:.1f} to {100 * high:.1f} %".replace("100.0", "100")
    return f"{successes} of {episodes} ({percent})" if episodes else "–"


def _table(rows: list[tuple[str, ...]]) -> str:
    """Return a table in Markdown; the first row is its head."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def urscript() -> str:
    """Return the table of the functions of URScript that the emulated controllers have, and the list of the others."""
    import numpy as np

    from ur_core.kinematics.ur10 import NOMINAL_DH
    from ur_emulator.builtins.table import builtins_of
    from ur_emulator.controller.controller import Controller
    from ur_emulator.profile import POLYSCOPES
    from ur_emulator.script.manual import MANUAL

    functions = {
        version: Controller("left", profile, np.zeros(6), 1, dh=NOMINAL_DH, builtins=builtins_of).program.builtins
        for version, profile in POLYSCOPES.items()
    }
    known = {name: function for each in functions.values() for name, function in each.items()}
    note = "The columns name the first version of PolyScope that has a function here."
    lines = ["## Functions that programs can call", "", note, ""]
    for module, names in MANUAL.items():
        rows = [("function", "CB3", "e-Series")]
        for name in sorted(names & known.keys()):
            call = ", ".join(each.name + _default(each) for each in inspect.signature(known[name]).parameters.values())
            first = (
                next((each for each, has in functions.items() if each.startswith(family) and name in has), "–")
                for family in ("3.", "5.")
            )
            rows.append((f"`{name}({call})`", *first))
        if len(rows) > 1:
            lines += [f"### Module {module}", "", _table(rows), ""]
    lines += ["## Functions that are not emulated", ""]
    for module, names in MANUAL.items():
        missing = ", ".join(f"`{name}`" for name in sorted(names - known.keys()))
        if missing:
            lines += [f"Module {module}: {missing}.", ""]
    return "\n".join(lines)


def _default(parameter: inspect.Parameter) -> str:
    return "" if parameter.default is inspect.Parameter.empty else f"={parameter.default!r}"


def slug(env_id: str) -> str:
    """Return the name of a task's page: "sync-carry" of "DualUR10/SyncCarry-v0"; other namespaces come first."""
    space, name = env_id.rsplit("-v", 1)[0].split("/")
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", name).lower()
    return words if space == "DualUR10" else f"{space.lower()}-{words}"


def task_page(env_id: str, folder: Path) -> str:
    """Return the page of a task: how it looks, who solves it, what is observed, how to change it, and its reference."""
    import jinja2

    from dual_ur10.envs.core.setup import load_task
    from dual_ur10.ids import TASKS
    from dual_ur10.policies.registry import names_for

    task, path = load_task(env_id), TASKS[env_id].task
    name = env_id.partition("/")[2].rpartition("-v")[0]
    policies = names_for(env_id)
    layout = task.layout_for(task.settings_type())
    goals = path.partition(":")[0].rpartition(".")[0] + ".goals"
    scratch = f"images/learning_{slug(env_id)}_from_scratch.png"
    table = re.search(
        rf"^### Policies of {name}\n\n((?:\|.*\n)+)", (folder / "reference" / "benchmarks.md").read_text(), re.MULTILINE
    )
    record = folder / "media" / "media.json"
    template = jinja2.Template((folder / "task.j2").read_text(), keep_trailing_newline=True)
    return template.render(
        env_id=env_id,
        name=name,
        short=name if env_id.startswith("DualUR10/") else env_id,
        slug=slug(env_id),
        summary=summary_of(task),
        media=[each for each in json.loads(record.read_text()) if each["env_id"] == env_id] if record.exists() else [],
        policies=policies,
        best="learned" if "learned" in policies else [*policies, "random"][0],
        baselines=table[1] if table else _baselines_of(env_id),
        curves=curves_of(env_id),
        scratch=scratch if (folder / scratch).exists() else "",
        layout=layout,
        view=[each.name for each in layout.fields if each.concise],
        weights=task.weights,
        success={
            each.name: each.default
            for each in dataclasses.fields(task.settings_type)
            if each.name.startswith("success_") and isinstance(each.default, float)
        },
        definition=re.sub(r"^(#+ )", r"#\1", inspect.getdoc(task) or "", flags=re.MULTILINE),
        goals=goals if importlib.util.find_spec(goals) else "",
    )


def _baselines_of(env_id: str) -> str:
    """Return the baselines of one task as a table; "": it was not measured."""
    found = _measured().get(env_id.partition("/")[2]) if env_id.startswith("DualUR10/") else None
    return f"{_table([_BASELINES, *_baseline_rows(found)])}\n" if found else ""


def summary_of(task: Any) -> str:
    """Return the first sentence of a task's documentation."""
    return " ".join((inspect.getdoc(task) or "").partition("\n\n")[0].split())


def curves_of(env_id: str) -> dict[str, Path]:
    """Return the learning curves of the policies that come with a task, by their names."""
    from dual_ur10.policies.registry import shipped_folder, shipped_names

    curves = {name: shipped_folder(name, env_id) / "curve.png" for name in shipped_names(env_id)}
    return {name: path for name, path in curves.items() if path.exists()}


def task_table() -> str:
    """Return the table of all tasks, each with a link to its page."""
    from dual_ur10.envs.core.setup import load_task
    from dual_ur10.ids import TASKS

    rows = [("id", "task")]
    for env_id in TASKS:
        rows.append((f"[`{env_id}`](../tasks/{slug(env_id)}.md)", summary_of(load_task(env_id))))
    return _table(rows)


TABLES = {
    "reference/environments.md": ("<!-- table of tasks -->", task_table),
    "reference/robots.md": ("<!-- table of robots -->", robots),
    "reference/urscript.md": ("<!-- table of URScript -->", urscript),
    "reference/baselines.md": ("<!-- table of baselines -->", baselines),
    "how-to/train-your-own.md": ("<!-- table of the ladder -->", ladder),
    "how-to/evaluate.md": ("<!-- table of agreement -->", agreement),
}
"""Marks that generated tables replace, by page."""


KEY_LENGTH = 24
"""Largest number of characters of a code that a table keeps in one line: a third of the text's width on a laptop."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Insert generated tables."""
    mark, table = TABLES.get(page.file.src_uri, ("", str))
    return markdown.replace(mark, table()) if mark else markdown


def on_page_content(html: str, **_: Any) -> str:
    """Mark short keys of tables, which the style sheet keeps in one line, and let lines end at parts of other code."""

    def parted(found: re.Match[str]) -> str:
        return re.sub(r"(?<=[/_.])(?=\w)|(?<=[a-z])(?=[A-Z][a-z])", "<wbr>", found[0])

    def cell(found: re.Match[str]) -> str:
        return re.sub(r"(?<=>)[^<]+(?=</code>)", parted, found[0])

    html = re.sub(rf"(?<=<td>)<code>(?=[^<]{{1,{KEY_LENGTH}}}</code>)", '<code class="key">', html)
    html = re.sub(r"<td>.*?</td>", cell, html, flags=re.DOTALL)
    return re.sub(r"(?<=<td>)(\d+)-(\d+)(?=</td>)", "\\1\N{NON-BREAKING HYPHEN}\\2", html)


def decisions(folder: Path) -> str:
    """Return the list of decision records with their titles."""
    rows = []
    for path in sorted(folder.glob("*.md")):
        if path.name != "index.md":
            rows.append(f"- [{path.read_text().splitlines()[0].removeprefix('# ')}]({path.name})")
    return "# Decisions\n\nShort records of design choices: context, decision, evidence.\n\n" + "\n".join(rows) + "\n"


def of_repository(path: Path) -> str:
    """Return a page at the top of the repository with its links as they are on the site."""
    text = re.sub(r"\]\(docs/decisions/\)", "](decisions/index.md)", path.read_text())
    text = re.sub(r"\]\(docs/", "](", text)
    text = re.sub(r"\]\(packages/([\w-]+)/CHANGELOG\.md\)", r"](changelog-\1.md)", text)
    return re.sub(r"\]\(([A-Z]+)\.md\)", lambda found: f"]({found[1].lower()}.md)", text)


def pages(folder: Path) -> dict[str, Callable[[], str]]:
    """Return the functions that generate the pages of this folder, by page."""
    from dual_ur10.ids import TASKS

    return {
        **{f"tasks/{slug(env_id)}.md": partial(task_page, env_id, folder) for env_id in TASKS},
        "reference/cli.md": partial(command_line, "dual-ur10"),
        "reference/cli-ur-emulator.md": partial(command_line, "ur-emulator"),
        "reference/cell-file.md": cell_file,
        "reference/errors.md": errors,
        "decisions/index.md": lambda: decisions(folder / "decisions"),
        "changelog.md": lambda: of_repository(folder.parent / "CHANGELOG.md"),
        **{
            f"changelog-{name}.md": partial(of_repository, folder.parent / "packages" / name / "CHANGELOG.md")
            for name in ("ur-core", "ur-emulator")
        },
        "contributing.md": lambda: of_repository(folder.parent / "CONTRIBUTING.md"),
    }


def on_config(config: Any) -> Any:
    """Add the tasks and the decision records to the navigation, and the address of the repository, if it has one."""
    from dual_ur10.ids import TASKS

    config["nav"].insert(1, {"Tasks": [f"tasks/{slug(env_id)}.md" for env_id in TASKS]})
    records = sorted(path.name for path in (Path(config["docs_dir"]) / "decisions").glob("*.md"))
    config["nav"].append({"Decisions": ["decisions/index.md", *(f"decisions/{name}" for name in records)]})
    project = tomllib.loads((Path(config["docs_dir"]).parent / "pyproject.toml").read_text())
    if repository := project["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]:
        config["repo_url"], config["repo_name"] = repository, "/".join(repository.rstrip("/").split("/")[-2:])
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages, and the learning curves of the policies that come with the package."""
    from dual_ur10.ids import TASKS

    for name, page in pages(Path(config["docs_dir"])).items():
        files.append(File.generated(config, name, content=page()))
    for env_id in TASKS:
        for name, path in curves_of(env_id).items():
            files.append(File.generated(config, f"tasks/{slug(env_id)}-{name}.png", abs_src_path=str(path)))
    return files
