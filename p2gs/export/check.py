"""``p2gs export RUN --check``: the files of an export in every engine and validator that is installed, as one table."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import shutil
import subprocess
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
    """files: that it reads, the one it judges first.  run: takes the folder, returns what is wrong.  package: of Python that ``run``
    imports; none for programs of node.  there: whether it is installed.  how: it is installed."""

    package: str
    files: tuple[str, ...]
    run: Callable[[Path], list[str]]
    how: str = "pip install p2gs[validate]"

    @property
    def there(self) -> bool:
        return importlib.util.find_spec(self.package) is not None if self.package else gltf_validator_path() is not None


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


def _urchin(folder: Path) -> list[str]:
    import urchin

    robot = urchin.URDF.load(str(folder / "twin.urdf"))
    poses = robot.visual_trimesh_fk()  # fails where a mesh cannot be read
    return [] if poses else ["no mesh to show"]


def _urdf_validator(folder: Path) -> list[str]:
    from urdf_validator_main.checks.schema import run
    from urdf_validator_main.parser.urdf_adapter import load_urdf
    from urdf_validator_main.report.models import ValidationReport

    path = str(folder / "twin.urdf")
    robot = load_urdf(path)
    if not hasattr(robot, "links"):
        return [str(robot)]
    report = ValidationReport(path, robot.name, "", "", "", "")
    run(robot, report)
    return list(report.schema.critical_issues)


@functools.cache
def gltf_validator_path() -> str | None:
    """Khronos' gltf-validator (an npm package) as node finds it: installed here, or for everyone (npm install -g). None without node."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None:
        return None
    everyone = subprocess.run([npm, "root", "-g"], capture_output=True, text=True).stdout.strip() if npm else ""
    paths = os.pathsep.join(p for p in (os.environ.get("NODE_PATH", ""), everyone) if p)
    words = [node, "-e", "process.stdout.write(require.resolve('gltf-validator'))"]
    found = subprocess.run(words, capture_output=True, text=True, env=os.environ | {"NODE_PATH": paths})
    return found.stdout if found.returncode == 0 else None


GLTF_SCRIPT = """const [path, file] = process.argv.slice(1);
require(path).validateBytes(new Uint8Array(require('fs').readFileSync(file)), {maxIssues: 0})
  .then(report => process.stdout.write(JSON.stringify(report.issues.messages)), error => { console.error(error); process.exit(1); });"""
WRONG = 1  # the highest severity that is told: 0 error, 1 warning


def _gltf(name: str) -> Callable[[Path], list[str]]:
    def run(folder: Path) -> list[str]:
        words = ["node", "-e", GLTF_SCRIPT, gltf_validator_path() or "", str(folder / name)]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode != 0:
            return [" ".join(done.stderr.split())[:300]]
        issues = [m for m in json.loads(done.stdout) if m["severity"] <= WRONG and not _unknown_splats(m)]
        return sorted({f"{m['code']} at {m.get('pointer', '?')}: {m['message']}" for m in issues})

    return run


def _unknown_splats(issue: dict) -> bool:
    """Whether the validator says no more than that it does not know KHR_gaussian_splatting."""
    return issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and "KHR_gaussian_splatting:" in issue.get("pointer", "")


NPM = "npm install -g gltf-validator"
VALIDATORS = {
    "MuJoCo": Validator("mujoco", ("twin.xml", "twin.urdf"), _engine("mujoco")),
    "PyBullet": Validator("pybullet", ("twin.urdf",), _engine("pybullet")),
    "SAPIEN": Validator("sapien", ("twin.urdf",), _engine("sapien")),
    "yourdfpy": Validator("yourdfpy", ("twin.urdf",), _yourdfpy),
    "urchin": Validator("urchin", ("twin.urdf",), _urchin),
    "urdf-validator": Validator("urdf_validator_main", ("twin.urdf",), _urdf_validator),
    "OpenUSD": Validator("pxr", ("twin.usda",), _usd),
    "gltf-validator": Validator("", ("twin.glb",), _gltf("twin.glb"), NPM),
    "gltf-validator, splats": Validator("", ("splats.glb",), _gltf("splats.glb"), NPM),
}


def check_folder(folder: Path) -> list[Checked]:
    """Every validator on the files in a folder. Raises UserError where it has none of them, or the file's z axis is not up."""
    if not any((folder / name).is_file() for validator in VALIDATORS.values() for name in validator.files):
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
    file = validator.files[0]
    if not validator.there:
        return Checked(tool, file, "not run", (f"not installed ({validator.how})",))
    missing = [name for name in validator.files if not (folder / name).is_file()]
    if missing:
        return Checked(tool, file, "not run", (f"{missing[0]} is not there",))
    try:
        problems = validator.run(folder)
    except Exception as err:  # a file that an engine refuses is a finding, whatever it raises
        problems = [f"{type(err).__name__}: {' '.join(str(err).split())[:300]}"]
    return Checked(tool, file, "fails" if problems else "passes", tuple(problems))


def check_table(results: list[Checked]) -> "Table":
    """A row each."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("checked with", "file", "verdict", "notes")
    for r in results:
        table.add_row(r.tool, r.file, r.state, escape("\n".join(r.notes)))
    return table
