"""Scores of a finished run: joints, surfaces and pictures against what the scene has. The only command that opens
ground truth.

``RUN/metrics.json`` (format p2gs-metrics/1), every length in input units, missing things left out and told in
``missing``:

    scene, num_parts, gaussians            name of the scene; counts of the twin
    match        how true parts found their predicted ones: "joints" or "mesh"
    parts        [{id, gaussians}]
    joints       {joints: [{gt, type, pred, pred_type, errors: {axis_angle, axis_position, motion} | null}], failures,
    extra, ...means}:
                 see metrics.joints.JointReport (axis_angle degrees, axis_position x10, motion degrees or length)
    views        {start, end, mean}: {split, count, psnr_white, psnr_black, ssim_white, ssim_black, psnr_masked, lpips
    (over white;
                 only with torchvision and its AlexNet weights at hand, see metrics.lpips), alpha_error,
                 depth_median, depth_p90, depth_bad}: photographs that the fit did not train on where there are any;
                 psnr_masked over the object's pixels only, alpha_error mean |alpha - mask|, depth_* of |depth - true|
                 on the object, by the Gaussians' planes, depth_bad the fraction off by more than 1 % of its diagonal
    chamfer      {static|movable|whole: {value, floor}, parts, failures}: x1000, see metrics.chamfer.ChamferReport
    chamfer_seen the same of the meshes without the faces that close what nobody saw
    penetration  {mean, max}: fraction of the moving Gaussians inside the base, over five states
    slots        with exact_parts: what became of every part slot, see models.slots.slot_report
    seconds      time the evaluation took
    missing      sentences
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Optional

import numpy as np

from p2gs.gaussians.paint import draw, rasterizer_of
from p2gs.gaussians.pose import pose
from p2gs.gaussians.twin_json import load_twin
from p2gs.gaussians.views import bounds
from p2gs.metrics.chamfer import PartMeshes, is_empty, match_parts, read_part_meshes
from p2gs.metrics.lpips import wanted as lpips_wanted
from p2gs.metrics.lpips import why_absent
from p2gs.metrics.modules import JointError, PartChamfer, Penetration, ViewQuality
from p2gs.models.registered import as_fitted
from p2gs.ops.planes import plane_features
from p2gs.surface.mesh import read_mesh, read_meshes
from p2gs.surface.protocol import surface_options
from p2gs.types import ArticulatedObject, TwoStateScene, UserError

if TYPE_CHECKING:
    from p2gs.data.ground_truth import GroundTruth

FORMAT = "p2gs-metrics/1"
STATES = ("start", "end")


@dataclass
class Surfaces:
    """Part meshes by state's name: the twin's ``made``, these without guessed faces, and the ``true`` ones."""

    made: dict[str, PartMeshes]
    seen: dict[str, PartMeshes]
    true: dict[str, PartMeshes]


def evaluate_run(
    run_dir: Path | str, root: Optional[Path | str] = None, match: Literal["joints", "mesh"] = "joints"
) -> dict:
    """Score a run, write RUN/metrics.json and return what it holds.

    root: the scene's folder where it has moved since the fit. match: true parts take the predicted ones whose joints
    are nearest, as ArtGS has it, or whose meshes are (``match_parts``). Raises UserError when the run is not finished,
    the scene's photographs cannot be read, or there are no meshes to match by; a scene without ground truth is scored
    by its photographs alone.
    """
    began = time.perf_counter()
    run_dir = Path(run_dir)
    obj = load_twin(run_dir)
    scene, truth = open_scene(run_dir, root)
    missing: list[str] = []
    metrics = {"format": FORMAT, "scene": scene.name, "num_parts": len(obj.parts), "gaussians": len(obj.gaussians)}
    metrics["parts"] = [{"id": p.id, "gaussians": int((obj.part_ids == p.id).sum())} for p in obj.parts]
    if truth is None:
        missing.append("the scene has no ground-truth joints or meshes")
    else:
        surfaces = read_surfaces(run_dir, truth, missing)
        assignment = None
        if match == "mesh":
            if surfaces is None:
                raise UserError(f"{run_dir}: there are no meshes to match parts by: {missing[-1]}")
            assignment = match_parts(surfaces.made, surfaces.true)
        joints = JointError()
        joints.update([p.joint for p in obj.parts if p.joint is not None], truth.joints, assignment)
        metrics["match"], metrics["joints"] = match, joints.report.to_dict()
        if surfaces is not None:
            chamfer = surface_scores(surfaces, joints.report.assignment, missing)
            metrics["chamfer"], metrics["chamfer_seen"] = chamfer
    with rasterizer_of(run_dir):
        metrics["views"] = view_scores(obj, scene, missing)
    inside = Penetration()
    inside.update(obj)
    metrics["penetration"] = inside.means()
    if (run_dir / "slots.json").is_file():
        metrics["slots"] = json.loads((run_dir / "slots.json").read_text())
    metrics["seconds"] = round(time.perf_counter() - began, 2)
    metrics["missing"] = missing
    path = run_dir / "metrics.json"
    path.with_suffix(".tmp").write_text(json.dumps(metrics, indent=1) + "\n")
    path.with_suffix(".tmp").replace(path)
    return metrics


def open_scene(run_dir: Path, root: Optional[Path | str] = None):
    """The scene of a run in input coordinates, its photographs corrected as the fit did, and its ground truth or None.

    The truth is the start's frame: the start's cameras are the ones it was measured with.
    """
    from p2gs.config.run import load_config
    from p2gs.data.ground_truth import load_ground_truth
    from p2gs.data.layouts import LAYOUTS

    path = Path(run_dir) / "config.yaml"
    if not path.is_file():
        raise UserError(f"{path} is missing, so the scene of this run is not known")
    cfg = load_config([str(path)], [] if root is None else ["--data.root", str(root)])
    scene = cfg.data.raw_scene()
    folder, name = getattr(cfg.data, "root", None), cfg.data_options["format"]
    truth = (
        None
        if folder is None
        else load_ground_truth(folder, name if name in LAYOUTS else None, cfg.data_options.get("source"))
    )
    return as_fitted(scene, run_dir), truth


def scene_folder(run_dir: Path) -> Path:
    """The folder of a run's scene, by the run's config.yaml. Raises UserError where that is missing."""
    from p2gs.config.run import load_config

    path = Path(run_dir) / "config.yaml"
    if not path.is_file():
        raise UserError(f"{path} is missing, so the scene of this run is not known")
    root = load_config([str(path)], []).data.root
    if root is None:
        raise UserError(f"{path}: the scene of this run lies in no folder (data.root is null)")
    return Path(root)


def view_scores(obj: ArticulatedObject, scene: TwoStateScene, missing: list[str]) -> dict:
    """Photometric and depth errors of both states and their mean. ``obj`` and ``scene`` in one coordinate system."""
    diagonal = float((bounds(obj)[1] - bounds(obj)[0]).norm())
    out = {}
    for state, name in enumerate(STATES):
        split = "test" if scene.select(state, "test") else "val" if scene.select(state, "val") else "train"
        views = scene.select(state, split)
        if split == "train" and views:
            missing.append(f"the {name} state has no test views: its training views are scored")
        if not views:
            missing.append(f"the {name} state has no photographs")
            continue
        gaussians, quality = pose(obj, float(state)), ViewQuality()
        for view in views:
            planes = None  # for depth alone
            if view.depth is not None:
                planes = plane_features(gaussians.means, gaussians.quats, gaussians.log_scales, view.camera)
            quality.update(draw(gaussians, view.camera, 0.0, features=planes), view, diagonal)
        out[name] = {"split": split, "count": len(views)} | quality.means()
    why = why_absent() if out and lpips_wanted() else None
    if why is not None:
        missing.append(why)
    if out and not any("depth_median" in s for s in out.values()):
        missing.append("the scene has no depth maps")
    both = [{k: v for k, v in s.items() if k not in ("split", "count")} for s in out.values()]
    if both:
        out["mean"] = _means(both)
    return out


def read_surfaces(run_dir: Path, truth: "GroundTruth", missing: list[str]) -> Optional[Surfaces]:
    """RUN/meshes and the ground truth's; None, and a sentence more in ``missing``, where either is missing."""
    pred, seen, gt = {}, {}, {}
    for state, name in enumerate(STATES):
        made, true = read_meshes(run_dir, name), truth.meshes(state)
        if made is None:
            missing.append("the run has no meshes (p2gs export RUN --format ply makes them)")
            return None
        if true.static is None or not true.dynamic:
            missing.append(f"the ground truth has no meshes of the {name} state's parts")
            return None
        whole_apart = surface_options(run_dir).whole == "separate"
        pred[name] = PartMeshes(
            made[0], made[1:], read_mesh(Path(run_dir) / "meshes" / name / "whole.ply") if whole_apart else None
        )
        shown = [m.only(~m.guessed) for m in made]
        seen[name] = PartMeshes(shown[0], shown[1:], pred[name].whole)
        gt[name] = read_part_meshes(true.whole, true.static, true.dynamic)
    return Surfaces(pred, seen, gt)


def surface_scores(surfaces: Surfaces, assignment: dict[int, int], missing: list[str]) -> tuple[dict, dict]:
    """Chamfer distances of the twin's meshes, and of their faces that are not guessed. assignment: true moving part ->
    predicted one."""
    reports = []
    for meshes in (surfaces.made, surfaces.seen):
        chamfer = PartChamfer()
        chamfer.update(meshes, surfaces.true, assignment)
        reports.append(chamfer.report)
    if reports[0].static is None:
        bare = all(m.static is None or is_empty(m.static) for m in surfaces.true.values())
        whose = "ground truth's" if bare else "twin's"
        missing.append(f"the {whose} static part has no surface, so there is no Chamfer distance of it")
    return reports[0].to_dict(), reports[1].to_dict()


def _means(rows: list[dict]) -> dict[str, float]:
    keys = dict.fromkeys(k for row in rows for k in row)
    return {k: float(np.mean([row[k] for row in rows if k in row])) for k in keys}
