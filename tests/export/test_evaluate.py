"""Scores of a finished run on the hand-made cabinet, whose photographs are its own renders."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from toy import start_parts, toy_scene, toy_twin

from p2gs.data.ground_truth import GroundTruth, MeshPaths
from p2gs.export.run_folder import write_twin
from p2gs.gaussians.frame import object_to_input
from p2gs.gaussians.paint import draw
from p2gs.gaussians.pose import pose
from p2gs.metrics.views import evaluate_view
from p2gs.scores import evaluate
from p2gs.scores.table import score_tables
from p2gs.surface.mesh import write_meshes
from p2gs.surface.surface_depth import surface_depth
from p2gs.types import TwoStateScene, UserError


def photograph(state, camera):
    out = draw(pose(toy_twin(), float(state)), camera, 0.0)
    return out.colour / out.alpha.clamp_min(1e-6)[..., None], out.alpha


@pytest.fixture(scope="module")
def scene() -> TwoStateScene:
    base = toy_scene(n=3, size=64, render=photograph)
    views = [replace(v, depth=surface_depth(pose(toy_twin(), float(v.state)), v.camera)[0]) for v in base.views]
    return base.with_views(views)


@pytest.fixture
def run(tmp_path, scene, monkeypatch):
    """A run folder whose scene and ground truth are the cabinet's."""

    def make(twin=None, truth=True, scene=scene):
        write_twin(twin or toy_twin(), tmp_path, scene, media=False)
        none = MeshPaths(None, None, ())
        gt = GroundTruth(tmp_path, tuple(start_parts()[1]), none, none) if truth is True else truth
        monkeypatch.setattr(evaluate, "open_scene", lambda run_dir, root=None: (scene, gt))
        return tmp_path

    return make


def test_a_perfect_twin_scores_perfectly(run):
    folder = run()
    m = evaluate.evaluate_run(folder)
    assert json.loads((folder / "metrics.json").read_text()) == m
    assert (
        m["format"] == "p2gs-metrics/1"
        and m["num_parts"] == 3
        and m["missing"] == ["the run has no meshes (p2gs export RUN --format ply makes them)"]
    )
    assert m["penetration"]["max"] <= 0.05
    assert m["joints"]["failures"] == 0 and m["joints"]["axis_angle_mean"] < 1e-4 and m["joints"]["motion_mean"] < 1e-4
    for name in ("start", "end"):
        v = m["views"][name]
        assert (v["split"], v["count"]) == ("test", 2)
        assert v["psnr_white"] > 45 and v["psnr_black"] > 45 and v["ssim_white"] > 0.99 and v["alpha_error"] < 3e-3
        assert v["depth_median"] < 1e-4 and v["depth_bad"] == 0


def test_a_twin_with_a_wrong_joint_scores_worse_where_it_should(run):
    """The drawer slides 0.1 too far: its motion error is 0.1, the end state's pictures suffer, the start state's do
    not."""
    twin = object_to_input(toy_twin())
    joint = twin.parts[2].joint
    T = joint.transform.clone()
    T[1, 3] = -0.5
    twin.parts[2] = replace(twin.parts[2], joint=replace(joint, motion=0.5, transform=T))
    m = evaluate.evaluate_run(run(twin))
    assert math.isclose(m["joints"]["joints"][1]["errors"]["motion"], 0.1, abs_tol=1e-6)
    assert m["views"]["end"]["psnr_white"] < 35 < m["views"]["start"]["psnr_white"]
    assert m["views"]["end"]["depth_bad"] > 0.01


def test_white_and_black_scores_are_those_of_composited_images(scene):
    """Against a slow twin: composite the twin's render and the photograph by hand over each background."""
    twin, view = toy_twin(), scene.select(1, "test")[0]
    row = evaluate_view(draw(pose(twin, 0.9), view.camera, 0.0), view, 1.0)
    for name, background in (("white", 1.0), ("black", 0.0)):
        render = draw(pose(twin, 0.9), view.camera, background).colour.clamp(0, 1).numpy()
        alpha = view.alpha.numpy()[..., None] / 255
        photo = view.image.numpy() / 255 * alpha + background * (1 - alpha)
        assert math.isclose(row[f"psnr_{name}"], -10 * math.log10(np.mean((render - photo) ** 2)), rel_tol=1e-3)


def test_without_ground_truth_the_photographs_are_scored_and_the_rest_is_told(run, scene):
    views = [replace(v, depth=None) for v in scene.views if v.split == "train"]
    m = evaluate.evaluate_run(run(truth=None, scene=scene.with_views(views)))
    assert "joints" not in m and m["views"]["start"]["split"] == "train" and "depth_median" not in m["views"]["mean"]
    told = " ".join(m["missing"])
    assert "no ground-truth" in told and "no test views" in told and "no depth" in told


def true_meshes(folder, t):
    """The cabinet's panels as quads, as a ground-truth folder of one state."""
    paths = []
    for k in range(3):
        g, ids = pose(toy_twin(), t), toy_twin().part_ids
        g = g[ids == k]
        u, v = (torch.eye(3)[g.log_scales.argsort(1, descending=True)[:, i]] * 0.025 for i in (0, 1))
        a = t * math.radians(-70) if k == 1 else 0.0
        R = torch.tensor([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
        corners = torch.stack(
            [g.means + s * (u @ R.T) + w * (v @ R.T) for s, w in ((-1, -1), (1, -1), (1, 1), (-1, 1))], 1
        ).reshape(-1, 3)
        quads = 4 * torch.arange(len(g))[:, None, None] + torch.tensor([[0, 1, 2], [0, 2, 3]])
        mesh = trimesh.Trimesh(corners.numpy(), quads.reshape(-1, 3).numpy(), process=False)
        paths.append(folder / f"{t}_{k}.ply")
        mesh.export(paths[-1])
    return MeshPaths(None, paths[0], tuple(paths[1:]))


def test_meshes_are_scored_against_the_true_ones(run, tmp_path, scene):
    folder = run(
        truth=GroundTruth(tmp_path, tuple(start_parts()[1]), true_meshes(tmp_path, 0.0), true_meshes(tmp_path, 1.0))
    )
    write_meshes(folder, resolution=40)
    c = evaluate.evaluate_run(folder)["chamfer"]
    assert c["failures"] == 0 and len(c["parts"]) == 2
    assert (
        c["movable"]["floor"] < c["movable"]["value"] < 20 and c["static"]["value"] < 40 and c["whole"]["value"] < 40
    )  # few coarse views: holes, but the right places


def test_parts_of_one_joint_are_told_apart_by_their_meshes(run, tmp_path):
    """Door and drawer have each other's joint in the truth: joints pair them wrongly, meshes rightly."""
    swapped = GroundTruth(
        tmp_path, tuple(start_parts()[1][::-1]), true_meshes(tmp_path, 0.0), true_meshes(tmp_path, 1.0)
    )
    folder = run(truth=swapped)
    with pytest.raises(UserError, match="no meshes to match parts by: the run has no meshes"):
        evaluate.evaluate_run(folder, match="mesh")
    write_meshes(folder, resolution=40)
    joints, mesh = (evaluate.evaluate_run(folder, match=m) for m in ("joints", "mesh"))
    assert (joints["match"], mesh["match"]) == ("joints", "mesh")
    assert [j["pred"] for j in joints["joints"]["joints"]] == [1, 0]
    assert [j["pred"] for j in mesh["joints"]["joints"]] == [0, 1] and mesh["joints"]["failures"] == 2
    assert mesh["chamfer"]["movable"]["value"] < 20 < joints["chamfer"]["movable"]["value"]


def test_a_joint_not_found_is_a_failure_in_the_table(run):
    from rich.console import Console

    twin = toy_twin()
    twin.part_ids[twin.part_ids == 2] = 0
    twin.parts = twin.parts[:2]
    m = evaluate.evaluate_run(run(twin))
    assert m["joints"]["failures"] == 1
    console = Console(width=160, record=True, file=open("/dev/null", "w"))
    console.print(score_tables(m))
    text = console.export_text()
    assert "prismatic (not found)" in text and "1 failed" in text and "2 test" in text


def test_a_run_without_config_is_told(tmp_path):
    with pytest.raises(UserError, match="config.yaml is missing"):
        evaluate.open_scene(tmp_path)


def test_an_unknown_depth_is_not_scored(scene):
    view = scene.select(0, "test")[0]
    none = replace(view, depth=torch.zeros_like(view.depth))
    assert "depth_median" not in evaluate_view(draw(pose(toy_twin(), 0.0), none.camera, 0.0), none, 1.0)
