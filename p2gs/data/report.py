"""Findings about a scene's files: the readers stop at the first error, ``p2gs data check`` lists them all."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from p2gs.types import UserError

Level = Literal["error", "note"]


@dataclass(frozen=True)
class Finding:
    """One clear sentence about one problem; it names the file. ``note``: worth knowing, but training can go on."""

    level: Level
    message: str


@dataclass
class Report:
    """Collects findings in the order in which they are met."""

    findings: list[Finding] = field(default_factory=list)

    def error(self, message: str) -> None:
        self.findings.append(Finding("error", message))

    def note(self, message: str) -> None:
        self.findings.append(Finding("note", message))

    def extend(self, findings: list[Finding]) -> None:
        """Take over what another report (of a worker thread) has collected, in its order."""
        for finding in findings:
            self.error(finding.message) if finding.level == "error" else self.note(finding.message)

    @property
    def failed(self) -> bool:
        return any(f.level == "error" for f in self.findings)


class StrictReport(Report):
    """The readers' report: raises UserError with the first error."""

    def error(self, message: str) -> None:
        super().error(message)
        raise UserError(message)
