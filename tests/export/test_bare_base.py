"""A twin whose base has no surface, in every format, opened by independent readers: joints hang on the world."""

import json
import struct
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import trimesh
from boxed import boxed_run

from p2gs.app import run as p2gs
from p2gs.export.asset import load_asset, start_box
from p2gs.export.checks.engines import ENGINES, check_engine, installed
from p2gs.export.files.glb import glb_bytes
from p2gs.export.formats import export_profile, export_run
from p2gs.export.naming import with_names
from p2gs.export.pages.report import write_report
from p2gs.export.physics.reach import extend_links
from p2gs.gaussians.twin_json import load_twin
from p2gs.metrics.penetration import evaluate_penetration
from p2gs.ops.mesh import Mesh
from p2gs.surface.mesh import read_meshes, write_mesh
from p2gs.types import UserError


def empty(folder, *parts):
    """The surfaces of these parts away, in both states."""
    for state in ("start", "end"):
        for k in parts:
            write_mesh(folder / "meshes" / state / f"part_{k}.ply", Mesh.empty())
        write_mesh(folder / "meshes" / state / "whole.ply", Mesh.join(read_meshes(folder, state)))
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return empty(boxed_run(tmp_path_factory.mktemp("bare") / "thing"), 0)


@pytest.fixture(scope="module")
def out(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    (folder / "parts").mkdir()
    (folder / "parts" / "base.ply").write_text("of an earlier export")
    export_run(run, ["all"], folder, splats=True)
    return folder


def bounds(run):
    return trimesh.load(run / "meshes" / "start" / "whole.ply", process=False).bounds


def glb_document(data):
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])


def test_urdf_hangs_an_empty_link_on_the_world(run, out):
    import yourdfpy

    links = {link.get("name"): len(link) for link in ET.parse(out / "twin.urdf").getroot().findall("link")}
    assert links["world"] == links["base"] == 0 and min(links["part_1"], links["part_2"]) > 2
    robot = yourdfpy.URDF.load(str(out / "twin.urdf"))
    assert robot.validate() and robot.base_link == "world" and robot.num_actuated_joints == 2
    assert np.allclose(robot.scene.bounds, bounds(run), atol=1e-4)
    assert not list((out / "assets").glob("base*"))


@pytest.mark.parametrize("file", ["twin.urdf", "twin.xml"])
def test_mujoco_opens_both(out, file):
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(out / file))
    moving = [model.body(f"part_{k}") for k in (1, 2)]
    assert model.nv == 2 and model.body("base").mass[0] == 0 and all(b.mass[0] > 0 for b in moving)


@pytest.mark.parametrize("name", ENGINES)
def test_joints_reach_their_limits_in_every_engine(name, out):
    if not installed(name):
        pytest.skip(f"{name} is not installed (pip install p2gs[validate])")
    assert check_engine(name, out).problems == []


def test_pybullet_lets_nothing_fall_though_nobody_told_it_to_fix_the_base(out):
    pybullet = pytest.importorskip("pybullet")
    from pybullet_utils.bullet_client import BulletClient

    client = BulletClient(pybullet.DIRECT)
    body = client.loadURDF(str(out / "twin.urdf"))
    client.setGravity(0, 0, -9.81)
    for _ in range(100):
        client.stepSimulation()
    assert client.getBasePositionAndOrientation(body)[0] == (0.0, 0.0, 0.0)


def test_usd_has_a_body_without_shapes_for_the_articulations_root(out):
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[validate])")
    from pxr import Usd, UsdGeom, UsdPhysics

    from p2gs.export.checks.validators import VALIDATORS

    stage = Usd.Stage.Open(str(out / "twin.usda"))
    base = stage.GetPrimAtPath("/twin/base")
    assert base.HasAPI(UsdPhysics.RigidBodyAPI) and not [p for p in Usd.PrimRange(base) if p.IsA(UsdGeom.Mesh)]
    assert base.GetAttribute("physics:mass").Get() > 0
    assert VALIDATORS["OpenUSD"].run(out).problems == ()


def test_glb_has_the_bases_node_without_a_mesh(run, out):
    document = glb_document((out / "twin.glb").read_bytes())
    assert [("mesh" in node) for node in document["nodes"]] == [False, False, True, True]
    assert [node["name"] for node in document["nodes"][1:]] == ["base", "part_1", "part_2"]
    sides = [np.ptp(b[:, 0]) for b in (trimesh.load(out / "twin.glb").bounds, bounds(run))]
    assert sides[0] == pytest.approx(sides[1], abs=1e-4)


def test_splats_keep_what_gaussians_the_base_has(run, out):
    names = [mesh["name"] for mesh in glb_document((out / "splats.glb").read_bytes())["meshes"]]
    assert names == ["base", "part_1", "part_2"] and (out / "splats.spz").stat().st_size > 0
    assert (out / "twin.usda").read_text().count("ParticleField3DGaussianSplat") == 3


def test_nothing_penetrates_a_base_without_gaussians(run):
    twin = load_twin(run)
    moving = twin.part_ids > 0
    alone = replace(twin, gaussians=twin.gaussians[moving], part_ids=twin.part_ids[moving])
    assert evaluate_penetration(alone) == {"mean": 0.0, "max": 0.0}


def test_ply_and_obj_have_no_file_of_it(out):
    assert {p.name for p in (out / "parts").iterdir() if p.suffix in (".ply", ".obj")} == {
        f"part_{k}.{kind}" for k in (1, 2) for kind in ("ply", "obj")
    }


@pytest.mark.parametrize("profile", ["simready", "isaac", "mujoco", "sapien", "partnet"])
def test_profiles_name_and_texture_what_there_is(profile, run, tmp_path):
    assert all(path.is_file() for path in export_profile(run, profile, tmp_path))
    if profile == "simready":
        text = (tmp_path / "thing" / "usd" / "thing.usda").read_text()
        assert text.count('def Mesh "visual"') == text.count('def Shader "picture"') == 2
        assert "int rigid_body_count = 3" in text
    if profile == "partnet":
        links = ET.parse(tmp_path / "mobility.urdf").getroot().findall("link")
        assert {link.get("name"): len(link) > 0 for link in links} == {
            "base": False,
            "link_0": True,
            "link_1": True,
            "link_2": False,
        }
        assert json.loads((tmp_path / "mobility_v2.json").read_text())[2]["parts"] == []
        assert json.loads((tmp_path / "result.json").read_text())[0]["children"][2]["objs"] == []


def test_moving_parts_are_named_by_their_own_shape(run):
    assert [link.label for link in with_names(load_asset(run, solid=False)).links] == ["body", "door", "drawer"]


def test_a_slide_that_nothing_holds_keeps_its_observed_range(run):
    asset = load_asset(run)
    door, drawer = (link.hinge for link in extend_links(asset.links)[1:])
    assert (drawer.lower, drawer.upper) == (asset.links[2].hinge.lower, asset.links[2].hinge.upper)
    assert door.upper - door.lower > asset.links[1].hinge.upper - asset.links[1].hinge.lower


def test_the_world_cannot_float(run, tmp_path, capsys):
    assert p2gs(["export", str(run), "--format", "urdf", "--out", str(tmp_path), "--floating"]) == 2
    told = capsys.readouterr().err
    assert "no base that could fall over" in told and told.count("\n") == 1


def test_the_report_shows_what_there_is(run):
    page = write_report(run).read_text()
    assert 'data-node="base"' in page and 'data-part="2"' in page
    nodes = glb_document(glb_bytes(load_asset(run, up="y", solid=False)))["nodes"]
    assert "mesh" not in nodes[1]


def test_a_moving_part_without_a_surface_is_left_out(tmp_path):
    asset = load_asset(empty(boxed_run(tmp_path / "thing"), 0, 1))
    assert [link.name for link in asset.links] == ["base", "part_2"] and asset.links[0].bare


def test_a_twin_without_any_surface_is_told_in_one_sentence(tmp_path, capsys):
    folder = empty(boxed_run(tmp_path / "thing"), 0, 1, 2)
    for told in (load_asset, start_box, write_report):
        with pytest.raises(UserError, match="no part of the twin has a surface"):
            told(folder)
    assert p2gs(["export", str(folder), "--format", "glb", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
