"""What judges the files of an export: physics engines, readers and validators of the formats, whichever are
installed."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Callable


@dataclass(frozen=True)
class Judged:
    """problems: what is wrong, a sentence each; none where the file passes.  remark: what was found, in figures."""

    problems: tuple[str, ...] = ()
    remark: str = ""


@dataclass(frozen=True)
class Validator:
    """files: that it reads, the one it judges first.  run: takes the folder.  package: of Python that ``run`` imports;
    none for programs of node.  there: whether it is installed.  how: it is installed."""

    package: str
    files: tuple[str, ...]
    run: Callable[[Path], Judged]
    how: str = "pip install p2gs[validate]"

    @property
    def there(self) -> bool:
        return importlib.util.find_spec(self.package) is not None if self.package else gltf_validator_path() is not None


def _engine(name: str) -> Callable[[Path], Judged]:
    def run(folder: Path) -> Judged:
        from p2gs.export.checks.engines import check_engine

        result = check_engine(name, folder)
        return Judged(tuple(result.problems), result.remark)

    return run


LONGEST = 1800.0  # s that an engine of simcheck's may take; its own 240 are too few for a twin on a busy machine


def _simcheck(name: str) -> Callable[[Path], Judged]:
    def run(folder: Path) -> Judged:
        import simcheck

        report = simcheck.check(str(folder / name), thresholds={"engine_timeout": LONGEST})
        done = sum(r.status == "pass" for r in report.results)
        # to simcheck a warning; but then its checks were not made
        late = [f for f in report.warnings if f.data.get("incomplete")]
        warned = "; ".join(f"warning, {f.check}: {f.message}" for f in report.warnings if f not in late)
        problems = tuple(f"{f.check}: {f.message}" for f in [*report.errors, *late])
        return Judged(problems, f"{done} checks pass{'; ' * bool(warned)}{warned}")

    return run


def _yourdfpy(folder: Path) -> Judged:
    import yourdfpy

    robot = yourdfpy.URDF.load(str(folder / "twin.urdf"))
    return Judged() if robot.validate() else Judged(tuple(str(e) for e in robot.errors))


def _usd(folder: Path) -> Judged:
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(folder / "twin.usda")))
    return Judged(tuple(e.GetMessage() for e in errors), f"{len(validators)} validators")


def _urchin(folder: Path) -> Judged:
    import urchin

    robot = urchin.URDF.load(str(folder / "twin.urdf"))
    poses = robot.visual_trimesh_fk()  # fails where a mesh cannot be read
    return Judged() if poses else Judged(("no mesh to show",))


def _urdf_validator(folder: Path) -> Judged:
    from urdf_validator_main.checks.schema import run
    from urdf_validator_main.parser.urdf_adapter import load_urdf
    from urdf_validator_main.report.models import ValidationReport

    path = str(folder / "twin.urdf")
    robot = load_urdf(path)
    if not hasattr(robot, "links"):
        return Judged((str(robot),))
    report = ValidationReport(path, robot.name, "", "", "", "")
    run(robot, report)
    return Judged(tuple(report.schema.critical_issues))


@functools.cache
def gltf_validator_path() -> str | None:
    """Khronos' gltf-validator (an npm package) as node finds it: installed here, or for everyone (npm install -g). None
    without node."""
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
  .then(report => process.stdout.write(JSON.stringify(report.issues.messages)),
        error => { console.error(error); process.exit(1); });"""
WRONG = 1  # the highest severity that is told: 0 error, 1 warning


def _gltf(name: str) -> Callable[[Path], Judged]:
    def run(folder: Path) -> Judged:
        words = ["node", "-e", GLTF_SCRIPT, gltf_validator_path() or "", str(folder / name)]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode != 0:
            return Judged((" ".join(done.stderr.split())[:300],))
        told = [m for m in json.loads(done.stdout) if m["severity"] <= WRONG]
        issues = [m for m in told if not _unknown_splats(m)]
        unknown = (
            f"{len(told) - len(issues)} times that it does not know KHR_gaussian_splatting"
            if len(told) > len(issues)
            else ""
        )
        return Judged(
            tuple(sorted({f"{m['code']} at {m.get('pointer', '?')}: {m['message']}" for m in issues})), unknown
        )

    return run


def _unknown_splats(issue: dict) -> bool:
    """Whether the validator says no more than that it does not know KHR_gaussian_splatting."""
    return issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and "KHR_gaussian_splatting:" in issue.get("pointer", "")


NPM = "npm install -g gltf-validator"
VALIDATORS = {
    "MuJoCo": Validator("mujoco", ("twin.xml", "twin.urdf"), _engine("mujoco")),
    "PyBullet": Validator("pybullet", ("twin.urdf",), _engine("pybullet")),
    "SAPIEN": Validator("sapien", ("twin.urdf",), _engine("sapien")),
    "simcheck": Validator("simcheck", ("twin.urdf",), _simcheck("twin.urdf")),
    "simcheck, MJCF": Validator("simcheck", ("twin.xml",), _simcheck("twin.xml")),
    "yourdfpy": Validator("yourdfpy", ("twin.urdf",), _yourdfpy),
    "urchin": Validator("urchin", ("twin.urdf",), _urchin),
    "urdf-validator": Validator("urdf_validator_main", ("twin.urdf",), _urdf_validator),
    "OpenUSD": Validator("pxr", ("twin.usda",), _usd),
    "gltf-validator": Validator("", ("twin.glb",), _gltf("twin.glb"), NPM),
    "gltf-validator, splats": Validator("", ("splats.glb",), _gltf("splats.glb"), NPM),
}


def main(tool: str, folder: str, told: str) -> None:
    """One of ``VALIDATORS`` on a folder; its ``Judged`` goes into the file ``told`` as JSON."""
    try:
        found = VALIDATORS[tool].run(Path(folder))
    except Exception as err:  # a file that a reader refuses is a finding, whatever it raises
        found = Judged((f"{type(err).__name__}: {' '.join(str(err).split())[:300]}",))
    Path(told).write_text(json.dumps(asdict(found)))


if __name__ == "__main__":
    main(*sys.argv[1:])
