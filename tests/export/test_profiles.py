"""What ``--profile`` writes, opened by independent readers; metadata, fixed and floating bases, masses and limits."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from boxed import boxed_run
from PIL import Image
from test_clearance import cabinet
from test_engines import with_looks

from p2gs.app import run as p2gs
from p2gs.export.asset import Asset, open_note
from p2gs.export.files.mjcf import write_mjcf
from p2gs.export.files.simready import file_name
from p2gs.export.files.urdf import write_urdf
from p2gs.export.files.usd import write_usd
from p2gs.export.formats import export_profile
from p2gs.export.links import HOLD, LIFT, QUICK
from p2gs.export.metadata import read_meta
from p2gs.export.physics.inertia import GRAVITY, enclosed, inertia_of
from p2gs.types import UserError

META = {
    "author": "Jane Doe",
    "asset_license": "CC-BY-4.0",
    "category": "StorageFurniture",
    "qcode": "Q10498396",
    "year": 2026,
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = boxed_run(tmp_path_factory.mktemp("toy") / "Toy cabinet")
    (folder / "media").mkdir()
    Image.new("RGB", (400, 300), (200, 100, 50)).save(folder / "media" / "start.png")
    (folder / "meta.yaml").write_text("\n".join(f"{k}: {v}" for k, v in META.items()))
    return folder


@pytest.fixture(scope="module")
def partnet(run, tmp_path_factory):
    out = tmp_path_factory.mktemp("partnet")
    words = ["--profile", "partnet", "--name", "part_2=tray", "--meta", str(run / "meta.yaml"), "--out", str(out)]
    assert p2gs(["export", str(run), *words]) == 0
    return out


def twin_joints(run):
    parts = json.loads((run / "twin.json").read_text())["parts"]
    return [p["joint"] for p in parts if p["kind"] == "movable"]


TURN = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # the data set's objects look along -x, the toy along -y


def test_partnets_urdf_moves_as_the_twin_does(run, partnet):
    import yourdfpy

    robot = yourdfpy.URDF.load(str(partnet / "mobility.urdf"))
    assert set(robot.link_map) == {"base", "link_0", "link_1", "link_2"} and robot.base_link == "base"
    want = trimesh.load(run / "meshes" / "start" / "whole.ply", process=False).vertices @ TURN.T
    assert np.allclose(robot.scene.bounds, [want.min(0), want.max(0)], atol=1e-4)
    start = [robot.get_transform(f"link_{i}", "base") for i in range(2)]
    joints = twin_joints(run)
    robot.update_cfg(
        {
            f"joint_{i}": math.radians(j["motion"]) if j["type"] == "revolute" else j["motion"]
            for i, j in enumerate(joints)
        }
    )
    for i, joint in enumerate(joints):
        T = np.eye(4)
        T[:3, :3] = TURN
        moved = T @ np.array(joint["transform"]) @ np.linalg.inv(T)
        assert np.allclose(robot.get_transform(f"link_{i}", "base"), moved @ start[i], atol=1e-6)


def test_partnets_other_files_agree_with_it(run, partnet):
    assert (partnet / "semantics.txt").read_text().splitlines() == [
        "link_0 hinge door",
        "link_1 slider tray",
        "link_2 heavy body",
    ]
    entries = json.loads((partnet / "mobility_v2.json").read_text())
    assert [(e["id"], e["parent"], e["joint"]) for e in entries] == [
        (0, 2, "hinge"),
        (1, 2, "slider"),
        (2, -1, "heavy"),
    ]
    Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for entry, joint in zip(entries, twin_joints(run), strict=False):
        axis, limit = entry["jointData"]["axis"], entry["jointData"]["limit"]
        assert np.allclose(axis["direction"], Y_UP @ joint["axis"]) and np.allclose(
            axis["origin"], Y_UP @ joint["origin"], atol=1e-6
        )
        assert np.allclose(sorted([limit["a"], limit["b"]]), sorted(joint["limits"]))  # degrees and units of length
    tree = json.loads((partnet / "result.json").read_text())[0]["children"]
    assert [c["id"] for c in tree] == [e["parts"][0]["id"] for e in entries]
    for child in tree:
        for name in child["objs"]:
            mesh = trimesh.load(partnet / "textured_objs" / f"{name}.obj", process=False)
            size = mesh.visual.material.image.size
            assert all(n & (n - 1) == 0 for n in size) and mesh.visual.uv is not None
    box = json.loads((partnet / "bounding_box.json").read_text())
    want = trimesh.load(run / "meshes" / "start" / "whole.ply", process=False).vertices @ Y_UP.T
    assert np.allclose([box["min"], box["max"]], [want.min(0), want.max(0)], atol=1e-4)
    assert json.loads((partnet / "meta.json").read_text())["model_cat"] == "StorageFurniture"


def test_sapien_loads_partnets_files(partnet):
    pytest.importorskip("sapien", reason="sapien is not installed (pip install p2gs[validate])")
    from p2gs.export.checks.engines import load_in_sapien

    scene, system, twin = load_in_sapien(partnet / "mobility.urdf")
    assert [j.name for j in twin.active_joints] == ["joint_0", "joint_1"] and len(twin.links) == 4
    assert scene.physx_system is system  # both must live as long as the articulation does


def test_simready_has_its_folders_metadata_labels_and_thumbnail(run, tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[validate])")
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation

    written = export_profile(run, "simready", tmp_path, run / "meta.yaml", material="wood")
    path = tmp_path / "toy_cabinet" / "usd" / "toy_cabinet.usda"
    assert written == [path, path.parent / ".thumbs" / "256x256" / "toy_cabinet.usda.png"]
    assert Image.open(written[1]).size == (256, 256)
    stage = Usd.Stage.Open(str(path))
    data = stage.GetRootLayer().customLayerData
    told = data["SimReady_Metadata"]
    assert {k: told[k] for k in META} == META and data["asset_name"] == told["asset_name"] == "toy_cabinet"
    bodies = [p for p in stage.Traverse() if p.HasAPI(UsdPhysics.RigidBodyAPI)]
    masses = [UsdPhysics.MassAPI(p).GetMassAttr().Get() for p in bodies]
    assert told["rigid_body_count"] == len(bodies) == 3 and told["mass"] == pytest.approx(sum(masses), rel=1e-5)
    box = UsdGeom.BBoxCache(0, ["default"]).ComputeWorldBound(stage.GetDefaultPrim()).ComputeAlignedRange()
    assert np.allclose(told["asset_extents"], box.GetSize(), atol=1e-4)
    assert list(stage.GetDefaultPrim().GetAttribute("semantics:labels:class").Get()) == ["StorageFurniture"]
    assert list(stage.GetDefaultPrim().GetAttribute("semantics:labels:wikidata_qcode").Get()) == ["Q10498396"]
    looks = [p for p in stage.Traverse() if p.IsA(UsdShade.Material)]
    assert len(looks) == 4 and all(list(p.GetAttribute("semantics:labels:material").Get()) == ["wood"] for p in looks)
    # SimReady's rule VG.002 compares them as they are written
    for prim in (p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)):
        assert (
            UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), Usd.TimeCode.Default())
            == prim.GetAttribute("extent").Get()
        )
    colliders = [p for p in stage.Traverse() if p.HasAPI(UsdPhysics.CollisionAPI)]
    for prim in colliders:
        contact = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
        assert contact.GetName() == "contact" and UsdPhysics.MaterialAPI(
            contact
        ).GetDynamicFrictionAttr().Get() == pytest.approx(0.6)
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [e.GetMessage() for e in context.Validate(stage)] == []


def test_a_profile_wants_a_folder_of_its_own_and_stands_on_its_own_axis(run, tmp_path, capsys):
    for words, told in (
        (["--profile", "sapien"], "give another folder with --out"),
        (["--profile", "sapiens", "--out", "x"], "did you mean 'sapien'"),
        (["--profile", "partnet", "--up", "z", "--out", "x"], "stand on y"),
        (["--profile", "isaac", "--format", "usd", "--out", "x"], "one or the other"),
        (["--meta", "x.yaml"], "no format but a profile holds it"),
    ):
        assert p2gs(["export", str(run), *words]) == 2
        assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    "text, told",
    [
        ("- a", "holds no fields"),
        ("author:", "'author' is empty"),
        ("a b: 1", "field 'a b'"),
        ("qcode: 42177", "expected Wikidata's identifier"),
        ("a: [", "neither YAML nor JSON"),
    ],
)
def test_wrong_metadata_gets_a_sentence(text, told, tmp_path):
    (tmp_path / "meta.yaml").write_text(text)
    with pytest.raises(UserError, match=told):
        read_meta(tmp_path / "meta.yaml")
    with pytest.raises(UserError, match="there is no file"):
        read_meta(tmp_path / "none.yaml")


def test_metadata_may_be_json_and_dates_are_texts(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(META))
    assert read_meta(tmp_path / "a.json") == META
    (tmp_path / "a.yaml").write_text("made: 2026-11-23\nmass_measured: 12.5\n")
    assert read_meta(tmp_path / "a.yaml") == {"made": "2026-11-23", "mass_measured": 12.5}


@pytest.mark.parametrize(
    "text, name", [("Toy cabinet", "toy_cabinet"), ("7 drawers", "asset_7_drawers"), ("Küche/2", "k_che_2")]
)
def test_file_names_are_what_every_system_takes(text, name):
    assert file_name(text) == name


@pytest.mark.parametrize("fixed", [True, False, None])
def test_the_base_stands_fast_or_floats(fixed, tmp_path):
    import mujoco
    import yourdfpy

    asset = replace(Asset("cabinet", with_looks(cabinet()), "z"), fixed=fixed)
    write_urdf(asset, tmp_path, mujoco=False)
    write_mjcf(asset, tmp_path)
    robot = yourdfpy.URDF.load(str(tmp_path / "twin.urdf"))
    assert robot.base_link == ("world" if fixed else "base") and "mujoco" not in (tmp_path / "twin.urdf").read_text()
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "twin.xml"))
    data = mujoco.MjData(model)
    for _ in range(50):
        mujoco.mj_step(model, data)
    assert (data.body("base").xpos[2] < -0.01) == (fixed is False)  # in free fall after 0.1 s: 5 cm
    # as it does not where the parent stands fast
    filtered = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    assert filtered == (fixed is not False)
    assert ("PhysicsFixedJoint" in write_usd(asset, tmp_path).read_text()) == (fixed is not False)


def test_a_closed_surface_weighs_its_volume_and_an_open_one_is_told():
    solid = trimesh.creation.annulus(0.3, 0.5, 1.0)  # a ring, which no convex piece would do for
    got = inertia_of([enclosed(solid.vertices, solid.faces)], 300.0)
    m = 300 * math.pi * (0.5**2 - 0.3**2)
    assert got.mass == pytest.approx(m, rel=0.02) and np.allclose(got.center, 0, atol=1e-6)
    assert got.matrix[2, 2] == pytest.approx(m * (0.5**2 + 0.3**2) / 2, rel=0.03)
    assert enclosed(solid.vertices, solid.faces[:-1]) is None and enclosed(solid.vertices, solid.faces[:, ::-1]) is None
    links = cabinet()
    assert open_note(Asset("cabinet", links, "z")) is None
    links[1] = replace(links[1], closed=False)
    assert "the mesh of part_1 is open" in open_note(Asset("cabinet", links, "z"))


def test_limits_of_effort_and_speed_go_by_weight_and_range(tmp_path):
    import mujoco

    asset = Asset("cabinet", with_looks(cabinet()), "z")
    door, drawer = (x.joint for x in asset.moving)
    drawer_load = GRAVITY * asset.links[2].inertia.mass
    hinge = replace(drawer, load=drawer_load)
    assert hinge.friction == pytest.approx(HOLD * drawer_load) and hinge.velocity == pytest.approx(0.4 / QUICK)
    assert hinge.effort == pytest.approx(LIFT * drawer_load + hinge.damping * 0.4 / QUICK)
    write_mjcf(replace(asset, links=[*asset.links[:2], replace(asset.links[2], joint=hinge)]), tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "twin.xml"))
    assert np.allclose(model.actuator_ctrlrange, [[-door.effort, door.effort], [-hinge.effort, hinge.effort]])


def test_usd_joints_are_damped_as_the_others_are(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[validate])")
    from pxr import Usd, UsdPhysics

    asset = Asset("cabinet", with_looks(cabinet()), "z")
    stage = Usd.Stage.Open(str(write_usd(asset, tmp_path)))
    for part, kind in ((1, "angular"), (2, "linear")):
        drive = UsdPhysics.DriveAPI(stage.GetPrimAtPath(f"/twin/joint_{part}"), kind)
        damping = asset.links[part].joint.damping * (math.pi / 180 if kind == "angular" else 1)  # USD counts degrees
        assert drive.GetDampingAttr().Get() == pytest.approx(damping, rel=1e-6) and drive.GetStiffnessAttr().Get() == 0
