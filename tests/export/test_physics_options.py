"""Size and mass as asked for; normals and extents in what is written."""

import json

import numpy as np
import pytest
import trimesh
from toy import toy_scene, toy_twin

from p2gs.app import run as p2gs
from p2gs.export.asset import DENSITIES, load_asset, start_box
from p2gs.export.run_folder import write_twin
from p2gs.export.sizes import unlikely_size
from p2gs.surface.mesh import write_meshes
from p2gs.types import Similarity


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    similarity, folder = Similarity(2.0, (0.2, 0.1, -0.3)), tmp_path_factory.mktemp("cabinet")
    write_twin(toy_twin(similarity), folder, toy_scene(similarity, n=12, size=110), media=False)
    write_meshes(folder, resolution=40)
    return folder


def test_height_sets_the_scale_and_obj_have_the_surfaces_normals(run, tmp_path, capsys):
    assert p2gs(["export", str(run), "--format", "obj", "--height", "0.85", "--out", str(tmp_path)]) == 0
    assert "warning" not in capsys.readouterr().err
    meshes = [trimesh.load(f, process=False) for f in sorted((tmp_path / "parts").glob("*.obj"))]
    z = np.concatenate([m.vertices for m in meshes])[:, 2]
    assert np.ptp(z) == pytest.approx(0.85, rel=0.02)
    text = (tmp_path / "parts" / "part_1.obj").read_text().splitlines()
    given = np.array([line.split()[1:] for line in text if line.startswith("vn ")], float)
    places = np.array([line.split()[1:4] for line in text if line.startswith("v ")], float)
    faces = np.array([[w.split("//") for w in line.split()[1:]] for line in text if line.startswith("f ")], int)
    assert len(given) == len(places) and (faces[..., 0] == faces[..., 1]).all()
    a, b, c = (places[faces[:, i, 0] - 1] for i in range(3))
    face = np.cross(b - a, c - a)
    assert np.mean(np.einsum("ij,ij->i", face, given[faces[:, 0, 1] - 1]) > 0) > 0.95


@pytest.mark.parametrize(
    "words, told",
    [
        (["--height", "0"], "--height: expected a positive number"),
        (["--material", "cheese"], "--material is 'cheese', expected one of chipboard"),
        (["--height", "1", "--scale", "2"], "not allowed with"),
    ],
)
def test_a_wrong_size_or_material_gets_a_sentence(run, tmp_path, capsys, words, told):
    assert p2gs(["export", str(run), "--format", "obj", "--out", str(tmp_path), *words]) == 2
    assert told in capsys.readouterr().err


def test_a_size_that_nothing_has_is_warned_of(run, tmp_path, capsys):
    assert p2gs(["export", str(run), "--format", "ply", "--scale", "10", "--out", str(tmp_path)]) == 0
    assert "longest side comes out as" in capsys.readouterr().err
    assert unlikely_size(0.8) is None and unlikely_size(0.001) is not None


def test_a_capture_without_a_scale_is_warned_of(run, tmp_path, capsys):
    scene, config = tmp_path / "scene", run / "config.yaml"
    scene.mkdir()
    config.write_text(f"data:\n  root: {scene}\n")
    words = ["export", str(run), "--format", "obj", "--out", str(tmp_path / "out")]
    try:
        for metric, more, warned in ((False, [], True), (False, ["--height", "1"], False), (True, [], False)):
            (scene / "capture.json").write_text(json.dumps({"scale": {"metric": metric}}))
            assert p2gs([*words, *more]) == 0
            assert ("says nothing of metres" in capsys.readouterr().err) == warned
    finally:
        config.unlink()


def test_a_laptop_as_large_as_a_table_is_warned_of(run, tmp_path, capsys):
    assert unlikely_size(1.4) is None and "a laptop: 0.2 to 0.7" in unlikely_size(1.4, "Laptop laptop_10211")
    meta = tmp_path / "meta.yaml"
    meta.write_text("category: Laptop\n")
    words = ["export", str(run), "--profile", "sapien", "--meta", str(meta), "--out", str(tmp_path / "out")]
    assert p2gs([*words, "--height", "1.4"]) == 0 and "(a laptop: 0.2 to 0.7)" in capsys.readouterr().err


def test_mass_goes_by_the_material(run):
    light, heavy = (load_asset(run, density=DENSITIES[m]) for m in ("chipboard", "glass"))
    for a, b in zip(light.links, heavy.links, strict=True):
        assert b.inertia.mass / a.inertia.mass == pytest.approx(DENSITIES["glass"] / DENSITIES["chipboard"])
        if a.joint is not None:  # holds its own weight's fiftieth, whatever it weighs
            assert a.joint.friction > 0 and b.joint.friction / a.joint.friction == pytest.approx(
                b.inertia.mass / a.inertia.mass
            )


def test_usd_meshes_have_extents_and_normals(run, tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[validate])")
    from pxr import Usd, UsdGeom

    assert p2gs(["export", str(run), "--format", "usd", "--out", str(tmp_path)]) == 0
    stage = Usd.Stage.Open(str(tmp_path / "twin.usda"))
    meshes = [UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    assert len(meshes) > 3
    for mesh in meshes:
        points = np.array(mesh.GetPointsAttr().Get())
        assert np.allclose(mesh.GetExtentAttr().Get(), [points.min(0), points.max(0)], atol=1e-5)
        normals = np.array(mesh.GetNormalsAttr().Get())
        assert normals.shape == points.shape and np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-3)
    box = start_box(run)
    assert (box[1] > box[0]).all()
