import doctest
import math

import numpy as np
import pytest

from p2gs.metrics import chamfer as C
from p2gs.ops.mesh import Mesh, largest_components


def box(size=(1.0, 1.0, 1.0), at=(0.0, 0.0, 0.0)):
    import trimesh

    mesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    return mesh


def test_docstrings_run():
    result = doctest.testmod(C)
    assert result.failed == 0
    assert result.attempted >= 6


def test_distance_is_its_definition():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(30, 3)), rng.normal(size=(20, 3))
    d = [[float(((x - y) ** 2).sum()) for y in b] for x in a]
    slow = sum(min(row) for row in d) / 30 + sum(min(d[i][j] for i in range(30)) for j in range(20)) / 20
    assert C.chamfer_distance(a, b) == pytest.approx(slow)
    assert C.chamfer_distance(b, a) == pytest.approx(slow)
    assert C.chamfer_distance(a, a) == 0


def test_sampling_is_uniform_by_area_and_repeats():
    mesh = box((1, 2, 3))
    points = C.sample_surface(mesh, 60_000, seed=1)
    assert (points == C.sample_surface(mesh, 60_000, seed=1)).all()
    assert (points != C.sample_surface(mesh, 60_000, seed=2)).any()
    half = np.array([0.5, 1, 1.5])
    on_face = np.isclose(np.abs(points), half)
    assert on_face.any(1).all()
    shares = on_face.mean(0)
    np.testing.assert_allclose(shares, np.array([6, 3, 2]) / 11, atol=0.01)
    inside = points[np.isclose(points[:, 0], 0.5)]
    counts, *_ = np.histogram2d(inside[:, 1], inside[:, 2], bins=4)
    assert counts.std() / counts.mean() < 0.1
    with pytest.raises(ValueError, match="without area"):
        C.sample_surface(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])), 10)


@pytest.mark.parametrize("size", [(1, 1, 1), (0.4, 0.8, 1.2)])
def test_a_perfect_mesh_scores_the_sampling_floor(size):
    mesh = box(size)
    floor = C.sampling_floor(C.surface_area(mesh))
    assert floor == pytest.approx(1000 * 2 * mesh.area / (math.pi * 10_000))
    assert C.mesh_chamfer(mesh, mesh) == pytest.approx(floor, rel=0.05)


def test_a_parallel_sheet_scores_twice_its_squared_distance():
    sheet = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    moved = Mesh(sheet.vertices + [0, 0, 0.1], sheet.faces)
    assert C.mesh_chamfer(sheet, moved) == pytest.approx(20 + C.sampling_floor(1.0), rel=0.01)


def test_small_components_are_dropped():
    import trimesh

    large = trimesh.creation.icosphere(3)
    crumb = trimesh.creation.icosphere(0)
    crumb.apply_translation([5, 0, 0])
    kept = largest_components(C.join([large, crumb]))
    assert len(kept.faces) == len(large.faces)
    assert len(largest_components(C.join([large, crumb]), fraction=0.01).faces) == len(large.faces) + len(crumb.faces)
    unwelded = Mesh(C.triangles(large).reshape(-1, 3), np.arange(3 * len(large.faces)).reshape(-1, 3))
    assert len(largest_components(unwelded, weld=True).faces) == len(large.faces)
    assert len(largest_components(Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))).faces) == 0


def states(static, movable):
    return {
        "start": C.PartMeshes(static, movable),
        "end": C.PartMeshes(static, [Mesh(m.vertices + [0, 0, 1.0], m.faces) for m in movable]),
    }


def test_an_object_is_scored_by_part_and_state():
    base, left, right = box((2, 2, 2)), box((0.5, 1, 1), (3, 0, 0)), box((0.5, 1, 1), (-3, 0, 0))
    gt = states(base, [left, right])
    off = Mesh(left.vertices + [0.2, 0, 0], left.faces)
    pred = states(base, [right, off, box(at=(9, 9, 9))])
    assignment = C.match_parts(pred, gt)
    assert assignment == {0: 1, 1: 0}
    report = C.evaluate_chamfer(pred, gt, assignment)
    assert report.static == pytest.approx(report.floors["static"], rel=0.05)
    assert report.parts[1] == pytest.approx(report.floors["movable"], rel=0.1)
    assert report.parts[0] > 10
    assert report.movable == pytest.approx(np.mean(report.parts))
    assert report.whole > report.floors["whole"]
    assert report.failures == 0
    exact = C.evaluate_chamfer(gt, gt, {0: 0, 1: 1}, count=2000, seeds=(0,))
    assert exact.whole == pytest.approx(C.sampling_floor(C.surface_area(gt["start"].all), 2000), rel=0.1)


def test_a_part_of_few_triangles_is_part_of_the_whole_and_crumbs_are_not():
    base, door = box((2, 2, 2)).subdivide().subdivide(), box((0.5, 1, 1), (3, 0, 0))
    assert len(door.faces) < 0.1 * len(base.faces)
    crumb = box((0.1, 0.1, 0.1), (5, 0, 0))
    crumbs = Mesh(
        np.concatenate([base.vertices, crumb.vertices]), np.concatenate([base.faces, crumb.faces + len(base.vertices)])
    )
    gt, pred = states(base, [door]), states(crumbs, [door])
    report = C.evaluate_chamfer(pred, gt, {0: 0}, seeds=(0,))
    assert report.whole == pytest.approx(report.floors["whole"], rel=0.1)
    assert C.evaluate_chamfer(pred, gt, {0: 0}, seeds=(0,), clean=0.0).whole > 1.2 * report.whole


def test_missing_parts_fail_and_are_counted():
    base, door = box((2, 2, 2)), box((0.5, 1, 1), (3, 0, 0))
    gt, pred = states(base, [door]), states(base, [])
    report = C.evaluate_chamfer(pred, gt, {}, count=500, seeds=(0,))
    assert (report.movable, report.parts, report.failures) == (None, [None], 1)
    assert C.match_parts(pred, gt) == {}
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    one_state = {"start": C.PartMeshes(base, [door]), "end": C.PartMeshes(base, [empty], whole=base)}
    assert C.evaluate_chamfer(one_state, gt, {0: 0}, count=500, seeds=(0,)).failures == 1
    assert set(report.to_dict()["static"]) == {"value", "floor"}


def test_files_are_read_and_missing_ones_keep_their_place(tmp_path):
    base, door = box((2, 2, 2)), box((0.5, 1, 1), (3, 0, 0))
    base.export(tmp_path / "part_0.ply")
    door.export(tmp_path / "part_2.ply")
    meshes = C.read_part_meshes(None, tmp_path / "part_0.ply", [tmp_path / "part_1.ply", tmp_path / "part_2.ply"])
    assert C.is_empty(meshes.movable[0])
    assert C.surface_area(meshes.movable[1]) == pytest.approx(door.area)
    assert C.surface_area(meshes.all) == pytest.approx(door.area + base.area)


def test_ground_truth_of_a_real_object_scores_its_floor(scenes):
    from p2gs.data.ground_truth import load_ground_truth

    truth = load_ground_truth(scenes / "artgs" / "storage4")
    gt = {n: C.read_part_meshes(p.whole, p.static, p.dynamic) for n, p in (("start", truth.start), ("end", truth.end))}
    backwards = {n: C.PartMeshes(m.static, m.movable[::-1], m.whole) for n, m in gt.items()}
    assignment = C.match_parts(backwards, gt)
    assert assignment == {0: 2, 1: 1, 2: 0}
    report = C.evaluate_chamfer(backwards, gt, assignment, seeds=(0,), clean=0.0)
    for name in ("static", "movable", "whole"):
        assert report.to_dict()[name]["value"] == pytest.approx(report.floors[name], rel=0.02)
    # thin walls, modelled from both sides
    assert report.floors["whole"] < C.sampling_floor(C.surface_area(gt["start"].whole))
