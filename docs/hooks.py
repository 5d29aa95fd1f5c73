"""Pages, tables and navigation that MkDocs generates: command line, cell file, errors, robots, list of decisions."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files


def command_line() -> str:
    """Return the reference of all commands and options, as the command line declares them."""
    import typer
    from typer.cli import get_docs_for_click

    from dual_ur10.cli.main import app

    command = typer.main.get_command(app)
    context = typer.Context(command, info_name="dual-ur10")
    text = get_docs_for_click(obj=command, ctx=context, name="dual-ur10", title="Command line")
    text = re.sub(r"^Example: (.*)$", r"Example: `\1`", text, flags=re.MULTILINE)
    return re.sub(r"\[/?(?:bold|cyan|dim|red|yellow|green)[^\]]*\]|\[/\]", "", text)


def cell_file() -> str:
    """Return the reference of all keys of a cell file."""
    from dual_ur10.sim2real.config.cell_file_reference import reference_page

    return reference_page()


def errors() -> str:
    """Return the tree of exceptions with the condition of each."""
    from dual_ur10 import errors as module

    lines = [
        "# Errors",
        "",
        "Every error is a `DualUR10Error`. Its message names what was found, what is allowed and what to do.",
        "",
    ]

    def branch(kind: type, depth: int) -> None:
        summary = inspect.getdoc(kind) or ""
        bases = [each.__name__ for each in kind.__bases__ if each.__module__ == "builtins" and each is not Exception]
        also = f" (also a `{'`, `'.join(bases)}`)" if bases else ""
        lines.append(f"{'    ' * depth}- **`{kind.__name__}`**{also}: " + " ".join(summary.split("\n\n")[0].split()))
        for each in kind.__subclasses__():
            if each.__module__ == module.__name__:
                branch(each, depth + 1)

    branch(module.DualUR10Error, 0)
    return "\n".join(lines) + "\n"


def robots() -> str:
    """Return the table of all models of arms."""
    from dual_ur10.kinematics.robots import ROBOTS

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


def _table(rows: list[tuple[str, ...]]) -> str:
    """Return a table in Markdown; the first row is its head."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def urscript() -> str:
    """Return the table of the functions of URScript that the emulated controllers have, and the list of the others."""
    import numpy as np

    from dual_ur10.kinematics.ur10 import NOMINAL_DH
    from ur_emulator.builtins import builtins_of
    from ur_emulator.controller import Controller
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


TABLES = {
    "reference/robots.md": ("<!-- table of robots -->", robots),
    "reference/urscript.md": ("<!-- table of URScript -->", urscript),
}
"""Marks that generated tables replace, by page."""


KEY_LENGTH = 24
"""Largest number of characters of a code that a table keeps in one line: a third of the text's width on a laptop."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Insert generated tables."""
    mark, table = TABLES.get(page.file.src_uri, ("", str))
    return markdown.replace(mark, table()) if mark else markdown


def on_page_content(html: str, **_: Any) -> str:
    """Mark the short keys of tables, which the style sheet keeps in one line."""
    return re.sub(rf"(?<=<td>)<code>(?=[^<]{{1,{KEY_LENGTH}}}</code>)", '<code class="key">', html)


def decisions(folder: Path) -> str:
    """Return the list of decision records with their titles."""
    rows = []
    for path in sorted(folder.glob("*.md")):
        if path.name != "index.md":
            rows.append(f"- [{path.read_text().splitlines()[0].removeprefix('# ')}]({path.name})")
    return "# Decisions\n\nShort records of design choices: context, decision, evidence.\n\n" + "\n".join(rows) + "\n"


def pages(folder: Path) -> dict[str, Callable[[], str]]:
    """Return the functions that generate the pages of this folder, by page."""
    return {
        "reference/cli.md": command_line,
        "reference/cell-file.md": cell_file,
        "reference/errors.md": errors,
        "decisions/index.md": lambda: decisions(folder / "decisions"),
    }


def on_config(config: Any) -> Any:
    """Add the decision records to the navigation, which then shows them beside each other."""
    records = sorted(path.name for path in (Path(config["docs_dir"]) / "decisions").glob("*.md"))
    config["nav"].append({"Decisions": ["decisions/index.md", *(f"decisions/{name}" for name in records)]})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    for name, page in pages(Path(config["docs_dir"])).items():
        files.append(File.generated(config, name, content=page()))
    return files
