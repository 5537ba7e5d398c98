"""Validators of formats pass what exports write and find what is planted; the extra names everything that --check
runs."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from test_clearance import cabinet
from test_engines import write
from test_splat_files import with_splats

from p2gs.export.checks import validators
from p2gs.export.checks.check import judged_apart
from p2gs.export.checks.validators import VALIDATORS
from p2gs.export.files.glb import write_glb
from p2gs.export.files.splats_gltf import write_splats
from p2gs.export.physics.clearance import clear_links


def test_the_extra_installs_all_of_them():
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    named = set(re.findall('"([a-z-]+)[<>=]', re.search(r"^validate = \[(.*?)^\]", text, re.S | re.M).group(1)))
    other = {"pxr": "usd-core", "urdf_validator_main": "urdf-validator"}
    assert {other.get(v.package, v.package) for v in VALIDATORS.values() if v.package} == named


def installed(name):
    if not VALIDATORS[name].there:
        pytest.skip(f"{name} is not installed ({VALIDATORS[name].how})")
    return VALIDATORS[name]


def test_simcheck_passes_a_twin_and_finds_a_mesh_that_is_gone(tmp_path):
    validator = installed("simcheck")
    write(clear_links(cabinet()).links, tmp_path)
    assert validator.run(tmp_path).problems == ()
    (tmp_path / "assets" / "part_1_collision_0.obj").unlink()
    assert any("part_1_collision_0" in p for p in validator.run(tmp_path).problems)


def test_a_simcheck_that_does_not_finish_is_no_pass(tmp_path, monkeypatch):
    validator = installed("simcheck")
    write(clear_links(cabinet()).links, tmp_path)
    monkeypatch.setattr(validators, "LONGEST", 0.001)
    assert any("did not finish" in p for p in validator.run(tmp_path).problems)


@pytest.mark.parametrize("name", ["gltf-validator", "gltf-validator, splats"])
def test_gltf_passes_but_for_the_extension_that_the_validator_does_not_know(name, tmp_path):
    validator = installed(name)
    asset, _ = with_splats("y")
    path = (write_splats if "splats" in name else write_glb)(asset, tmp_path)
    found = validator.run(tmp_path)
    assert found.problems == () and ("KHR_gaussian_splatting" in found.remark) == ("splats" in name)
    data = path.read_bytes()
    at = data.index(b'"nodes":[0]')
    path.write_bytes(data[:at] + b'"nodes":[9]' + data[at + 11 :])
    assert any("UNRESOLVED_REFERENCE" in p for p in validator.run(tmp_path).problems)


def test_a_validator_that_crashes_is_a_finding(tmp_path):
    found = judged_apart([sys.executable, "-c", "import os; os.abort()"])
    assert len(found.problems) == 1 and "crashed with signal 6" in found.problems[0]
    found = judged_apart([sys.executable, "-m", "p2gs.export.checks.validators", "yourdfpy", str(tmp_path)])
    assert len(found.problems) == 1 and "twin.urdf" in found.problems[0]


def test_only_what_the_validator_cannot_know_of_splats_is_left_out(tmp_path, monkeypatch):
    """By a validator that says what a real one says; without node, too."""
    said = [
        {
            "code": "MESH_PRIMITIVE_INVALID_ATTRIBUTE",
            "pointer": "/meshes/0/primitives/0/attributes/KHR_gaussian_splatting:SCALE",
        },
        {"code": "MESH_PRIMITIVE_INVALID_ATTRIBUTE", "pointer": "/meshes/0/primitives/0/attributes/SCALE"},
        {"code": "ACCESSOR_MIN_MISMATCH", "pointer": "/accessors/0/min/0"},
    ]
    out = json.dumps(
        [m | {"message": "Wrong.", "severity": 0} for m in said]
        + [{"code": "UNUSED_OBJECT", "message": "", "severity": 2}]
    )
    monkeypatch.setattr(validators, "gltf_validator_path", lambda: "there")
    monkeypatch.setattr(validators.subprocess, "run", lambda words, **_: subprocess.CompletedProcess(words, 0, out, ""))
    found = VALIDATORS["gltf-validator, splats"].run(tmp_path)
    assert [p.split()[0] for p in found.problems] == ["ACCESSOR_MIN_MISMATCH", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"]
    assert found.remark.startswith("1 times")
