"""Findings about a scene's files: the readers stop at the first error, ``p2gs data check`` lists them all."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Optional

from p2gs.types import UserError

Level = Literal["error", "note"]


@dataclass(frozen=True)
class Finding:
    """One clear sentence about one problem; it names the file. ``note``: worth knowing, but training can go on."""

    level: Level
    message: str


@dataclass
class Report:
    """Collects findings in the order in which they are met.

    root: the scene's folder, out of which files should not lead (None: anything may be read).  strict: those that do
    are errors.
    """

    findings: list[Finding] = field(default_factory=list)
    root: Optional[Path] = None
    strict: bool = False
    opened: set[Path] = field(default_factory=set, repr=False)  # resolved; every file that was asked for
    _named: set[Path] = field(default_factory=set, repr=False)  # folders outside of the root that have been named

    def error(self, message: str) -> None:
        self.findings.append(Finding("error", message))

    def note(self, message: str) -> None:
        self.findings.append(Finding("note", message))

    def extend(self, findings: list[Finding]) -> None:
        """Take over what another report (of a worker thread) has collected, in its order."""
        for finding in findings:
            self.error(finding.message) if finding.level == "error" else self.note(finding.message)

    def may_read(self, path: Path) -> bool:
        """Whether a file may be opened; asked before it is. One that leads out of the root (``..``, an absolute path, a
        link) is named, once for each folder that such files lie in; where ``strict``, it is an error and False."""
        try:
            real = path.resolve()
            self.opened.add(real)
            inside = self.root is None or real.is_relative_to(self.root.resolve())
        # a ring of links, a name that no file can have: there is nothing to read
        except (OSError, ValueError, RuntimeError):
            return True
        if inside:
            return True
        sentence = f"{path}: leads out of the scene's folder {self.root}, to {real}"
        if self.strict:
            self.error(f"{sentence}; refused, as strict_paths asks")
            return False
        if real.parent not in self._named:
            self._named.add(real.parent)
            self.outside(sentence)
        return True

    def outside(self, sentence: str) -> None:
        """A file outside of the root is about to be read."""
        self.note(sentence)

    @property
    def failed(self) -> bool:
        return any(f.level == "error" for f in self.findings)


class StrictReport(Report):
    """The readers' report: raises UserError with the first error."""

    def error(self, message: str) -> None:
        super().error(message)
        raise UserError(message)

    def outside(self, sentence: str) -> None:
        super().outside(sentence)
        print(f"note: {sentence}", file=sys.stderr, flush=True)
