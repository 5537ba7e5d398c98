"""What is each guess at unseen surface worth? A bench tool that reads ground truth, which no phase may.

    python bench/surface_steps.py RUN... [--out FILE] [--threads N]

The meshes of a finished run are made anew, as ``fit`` makes them before it closes them and without each step of them,
and scored as ``p2gs test`` scores them. A line of JSON per run goes to FILE: Chamfer distance (x1000) of the static
part, the moving parts' mean and the whole, and triangles, with everything ("all") and without each step that changes
them.
"""

from __future__ import annotations

import argparse
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Iterator
from unittest import mock

import torch
from ladder import write_row

import p2gs.surface.mesh as meshing
import p2gs.surface.sightings as sightings
import p2gs.surface.unseen as unseen
from p2gs.gaussians.paint import rasterizer_of
from p2gs.gaussians.twin_json import load_twin
from p2gs.gaussians.views import read_cameras
from p2gs.metrics.chamfer import PartMeshes, evaluate_chamfer, read_part_meshes
from p2gs.metrics.modules import JointError
from p2gs.ops.mesh import Mesh
from p2gs.scores.evaluate import open_scene
from p2gs.surface.sightings import start_motion
from p2gs.types import UserError


def as_given(first, *rest, **options):
    """Instead of a step: its first argument."""
    return first


# step -> what is called instead: (module, name, function)
STEPS = {
    "bridges": [(meshing, "bridged", as_given)],
    "unseen sides": [(meshing, "close_unseen_sides", as_given)],
    "plinths": [(unseen, "plinth_height", lambda *a: 0.0)],
    "trays": [(sightings, "find_tray", lambda *a: None)],
    "way of trays": [(meshing, "clear_way", as_given), (meshing, "not_the_trays", as_given)],
    "pieces that slide": [(meshing, "join_pieces", as_given)],
    "crumbs": [(sightings, "without_crumbs", as_given)],
}
SEEN = {"crumbs"}  # of what was seen; the others guess, and leave that as it is


@contextmanager
def left_out(name: str | None) -> Iterator[None]:
    """Without the step (None: with all)."""
    with ExitStack() as stack:
        for where, what, instead in STEPS[name] if name else ():
            stack.enter_context(mock.patch.object(where, what, instead))
        yield


def same(a: list[Mesh], b: list[Mesh]) -> bool:
    """Have two lists of meshes the same triangles?"""
    return all(
        x.faces.shape == y.faces.shape and x.vertices.shape == y.vertices.shape and (x.faces == y.faces).all()
        for x, y in zip(a, b, strict=True)
    )


def scored(obj, meshes: list[Mesh], true: dict, assignment: dict[int, int]) -> dict:
    """Chamfer distances of meshes in the start state, and their triangles."""
    made = {}
    for t, state in enumerate(true):
        moved = [m.transformed(start_motion(obj, k, float(t)).numpy()) for k, m in enumerate(meshes)]
        made[state] = PartMeshes(moved[0], moved[1:])
    report = evaluate_chamfer(made, true, assignment)
    return {"static": report.static, "movable": report.movable, "whole": report.whole} | {
        "faces": sum(len(m.faces) for m in meshes)
    }


def steps(run: Path) -> dict:
    """A run's line."""
    obj, truth = load_twin(run), open_scene(run)[1]
    if truth is None:
        raise UserError(f"{run}: its scene has no ground truth to score meshes by")
    true = {}
    for state, name in enumerate(("start", "end")):
        paths = truth.meshes(state)
        true[name] = read_part_meshes(paths.whole, paths.static, paths.dynamic)
    joints = JointError()
    joints.update([p.joint for p in obj.parts if p.joint is not None], truth.joints)
    rows, everything = {}, []
    with rasterizer_of(run):
        cameras = meshing.mesh_cameras(obj, read_cameras(run / "cameras.json"))
        seen = meshing.sight(obj, cameras)
        shown = seen.surfaces()
        for name in (None, *STEPS):
            with left_out(name):
                meshes = meshing.completed(obj, seen, seen.surfaces() if name in SEEN else shown)
            if name is not None and same(meshes, everything):
                continue
            everything = everything or meshes
            rows[name or "all"] = scored(obj, meshes, true, joints.report.assignment)
    return {"run": run.name, "without": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    for run in options.runs:
        write_row(steps(run), options.out)


if __name__ == "__main__":
    main()
