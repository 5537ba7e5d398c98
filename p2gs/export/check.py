"""``p2gs export RUN --check``: the files of an export in every engine and validator that is installed, as one table."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Callable

from p2gs.types import UserError

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class Checked:
    """state: passes, fails, or not run.  notes: what is wrong, or why it was not run, a sentence each."""

    tool: str
    file: str
    state: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Validator:
    """package: that ``run`` imports.  file: that it reads.  run: takes the folder, returns what is wrong."""

    package: str
    file: str
    run: Callable[[Path], list[str]]


def _engine(name: str) -> Callable[[Path], list[str]]:
    def run(folder: Path) -> list[str]:
        from p2gs.export.engines import check_engine

        return check_engine(name, folder).problems

    return run


def _yourdfpy(folder: Path) -> list[str]:
    import yourdfpy

    robot = yourdfpy.URDF.load(str(folder / "twin.urdf"))
    return [] if robot.validate() else [str(e) for e in robot.errors]


def _usd(folder: Path) -> list[str]:
    from pxr import Usd, UsdValidation

    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    return [e.GetMessage() for e in context.Validate(Usd.Stage.Open(str(folder / "twin.usda")))]


VALIDATORS = {
    "MuJoCo": Validator("mujoco", "twin.xml", _engine("mujoco")),
    "PyBullet": Validator("pybullet", "twin.urdf", _engine("pybullet")),
    "SAPIEN": Validator("sapien", "twin.urdf", _engine("sapien")),
    "yourdfpy": Validator("yourdfpy", "twin.urdf", _yourdfpy),
    "OpenUSD": Validator("pxr", "twin.usda", _usd),
}


def check_folder(folder: Path) -> list[Checked]:
    """Every validator on the files in a folder. Raises UserError where twin.urdf is not there, or the file's z axis is not up."""
    if not (folder / "twin.urdf").is_file():
        raise UserError(f"{folder}: has no twin.urdf to check; write it with p2gs export RUN --format urdf mjcf --out {folder}")
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
    if importlib.util.find_spec(validator.package) is None:
        return Checked(tool, validator.file, "not run", ("not installed (pip install p2gs[validate])",))
    if not (folder / validator.file).is_file():
        return Checked(tool, validator.file, "not run", ("the file is not there",))
    try:
        problems = validator.run(folder)
    except Exception as err:  # a file that an engine refuses is a finding, whatever it raises
        problems = [f"{type(err).__name__}: {' '.join(str(err).split())[:300]}"]
    return Checked(tool, validator.file, "fails" if problems else "passes", tuple(problems))


def check_table(results: list[Checked]) -> "Table":
    """A row each."""
    from rich.table import Table

    table = Table("checked with", "file", "verdict", "notes")
    for r in results:
        table.add_row(r.tool, r.file, r.state, "\n".join(r.notes))
    return table
