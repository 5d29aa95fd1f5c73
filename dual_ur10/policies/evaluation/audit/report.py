"""Findings of an audit, and its report."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

from dual_ur10.errors import SettingsError

Severity = Literal["note", "warning", "error"]
SEVERITIES: Final[tuple[Severity, ...]] = ("note", "warning", "error")


@dataclasses.dataclass(frozen=True, kw_only=True)
class AuditFinding:
    """Finding about a task.

    Attributes:
        severity: "note", "warning" (learning suffers), or "error" (a result of the task proves nothing).
        rule: Rule that found it: "script", "returns", "camping", "stages", "actions", "randomization",
            "observations", "cheats" or "speed".
        subject: Part of the task that it is about, such as the name of a field; a key of `Task.accepted`.
        found: Number found.
        limit: Number allowed; "": none.
        remedy: What to do; "": nothing.
    """

    severity: Severity
    rule: str
    subject: str
    found: str
    limit: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        limit = f" (limit: {self.limit})" if self.limit else ""
        remedy = f". {self.remedy}" if self.remedy else ""
        return f"{self.severity}: {self.rule}, {self.subject}: {self.found}{limit}{remedy}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class AuditReport:
    """Report on a task.

    Attributes:
        env_id: Id of the environment.
        kwargs: Its keywords.
        seed: First seed.
        quick: Episodes ended soon after the time of the script.
        script_return: Mean return of the script; None: there is none, or no reward.
        returns: Mean return of each behaviour, as a ratio of the script's.
        successes: Successful episodes and episodes, by behaviour.
        steps_per_s: Steps of the environment per second on this machine under its present load, script included.
        findings: All findings, the gravest first.
    """

    env_id: str
    kwargs: Mapping[str, Any]
    seed: int
    quick: bool
    script_return: float | None
    returns: Mapping[str, float]
    successes: Mapping[str, tuple[int, int]]
    steps_per_s: float
    findings: tuple[AuditFinding, ...]

    def above(self, severity: Severity = "note") -> tuple[AuditFinding, ...]:
        """Return the findings that are graver than a severity.

        Raises:
            SettingsError: There is no such severity.
        """
        if severity not in SEVERITIES:
            raise SettingsError(f"the severity is {severity!r}: it must be one of {', '.join(SEVERITIES)}")
        least = SEVERITIES.index(severity)
        return tuple(each for each in self.findings if SEVERITIES.index(each.severity) > least)

    def __str__(self) -> str:
        counts = {name: sum(each.severity == name for each in self.findings) for name in reversed(SEVERITIES)}
        text = ", ".join(f"{count} {name}{'' if count == 1 else 's'}" for name, count in counts.items())
        lines = [f"{self.env_id}: {text}"]
        if self.script_return is not None:
            lines[0] += f"; the script earns {self.script_return:.1f}"
        for name, (successes, of) in self.successes.items():
            share = f"{100 * self.returns[name]:6.1f} %" if name in self.returns else ""
            lines.append(f"  {name:28}{share:>8}  {successes} of {of}")
        return "\n".join([*lines, *map(str, self.findings)])

    def to_json(self, path: str | Path) -> None:
        """Write the report to a file."""
        Path(path).write_text(json.dumps(dataclasses.asdict(self), indent=2, default=str) + "\n")
