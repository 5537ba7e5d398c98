"""``p2gs export RUN --check``: the files of an export in every engine and validator that is installed, as one table."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Sequence

from p2gs.export.checks.validators import VALIDATORS, Judged, Validator
from p2gs.types import UserError

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class Checked:
    """state: passes, fails, or not run.  notes: what is wrong, or why it was not run, a sentence each; what was found
    where it passes."""

    tool: str
    file: str
    state: str
    notes: tuple[str, ...] = ()


def check_folder(folder: Path) -> list[Checked]:
    """Every validator on the files in a folder. Raises UserError where it has none of them, or the file's z axis is not
    up."""
    if not any((folder / name).is_file() for validator in VALIDATORS.values() for name in validator.files):
        raise UserError(
            f"{folder}: has no twin.urdf to check; write it with p2gs export RUN --format urdf mjcf --out {folder}"
        )
    gravity = _gravity(folder / "twin.xml")
    if gravity is not None and gravity[2] >= 0:
        raise UserError(f"{folder / 'twin.xml'}: its gravity is {gravity}, but checks need an export with --up z")
    return [_check(tool, validator, folder) for tool, validator in VALIDATORS.items()]


def _gravity(path: Path) -> tuple[float, ...] | None:
    if not path.is_file():
        return None
    try:
        option = ET.parse(path).getroot().find("option")
    except ET.ParseError as err:
        raise UserError(f"{path} is not readable XML: {err}") from err
    return (0.0, 0.0, -9.81) if option is None else tuple(float(x) for x in option.get("gravity", "0 0 -9.81").split())


def _check(tool: str, validator: Validator, folder: Path) -> Checked:
    file = validator.files[0]
    if not validator.there:
        return Checked(tool, file, "not run", (f"not installed ({validator.how})",))
    missing = [name for name in validator.files if not (folder / name).is_file()]
    if missing:
        return Checked(tool, file, "not run", (f"{missing[0]} is not there",))
    found = judged_apart([sys.executable, "-m", "p2gs.export.checks.validators", tool, str(folder)])
    notes = (*found.problems, *([found.remark] if found.remark else []))
    return Checked(tool, file, "fails" if found.problems else "passes", notes)


def judged_apart(words: Sequence[str]) -> Judged:
    """What a process of its own writes as JSON into the file that is its last argument: engines may crash, and print
    what they like."""
    with tempfile.TemporaryDirectory() as scratch:
        told = Path(scratch) / "judged.json"
        done = subprocess.run([*words, str(told)], capture_output=True, text=True, errors="replace")
        if done.returncode == 0 and told.is_file():
            found = json.loads(told.read_text())
            return Judged(tuple(found["problems"]), found["remark"])
    how = f"signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
    last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
    return Judged((f"it crashed with {how}: {last[:300]}",))


def check_table(results: list[Checked]) -> "Table":
    """A row each."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("checked with", "file", "verdict", "notes")
    for r in results:
        table.add_row(r.tool, r.file, r.state, escape("\n".join(r.notes)))
    return table
