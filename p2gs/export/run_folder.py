"""The result folder as the end of a fit leaves it."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Sequence

from p2gs.export.pages.media import scene_photos, write_media
from p2gs.gaussians.frame import gaussians_to_input, object_to_input
from p2gs.gaussians.paint import rasterizer_of
from p2gs.gaussians.pose import pose
from p2gs.gaussians.splat_ply import write_splat_ply
from p2gs.gaussians.twin_json import write_twin_json
from p2gs.gaussians.views import scene_cameras, write_cameras
from p2gs.types import ArticulatedObject, TwoStateScene


def write_twin(obj: ArticulatedObject, run_dir: Path | str, scene: TwoStateScene, media: bool = True) -> None:
    """RUN/splats/{canonical,start,end}.ply, RUN/cameras.json, RUN/media/*.png and, last, RUN/twin.json (its being there
    says: done).

    All in input coordinates, whatever similarity ``obj`` and ``scene`` carry.
    """
    run_dir = Path(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    remove_derived(run_dir)
    outer = object_to_input(obj)
    write_splat_ply(run_dir / "splats" / "canonical.ply", outer.gaussians, outer.part_ids)
    for name, t in (("start", 0.0), ("end", 1.0)):
        write_splat_ply(
            run_dir / "splats" / f"{name}.ply", gaussians_to_input(pose(outer, t), outer.similarity), outer.part_ids
        )
    cameras = scene_cameras(scene)
    write_cameras(run_dir / "cameras.json", cameras)
    if media:
        with rasterizer_of(run_dir):
            write_media(outer, run_dir / "media", [c.camera for c in cameras], scene_photos(scene, outer))
    write_twin_json(obj, run_dir / "twin.json")


def remove_derived(run_dir: Path) -> None:
    """Remove what was made of an earlier twin: its meshes, files for simulators, report and scores would be taken for
    the new one's."""
    names = ("meshes", "assets", "parts", "splats.glb", "report.html", "metrics.json", "slots.json")
    for path in (*run_dir.glob("twin.*"), *(run_dir / name for name in names)):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def complete_run(run_dir: Path | str, formats: Sequence[str] = ("urdf", "mjcf", "glb"), log=print) -> None:
    """The rest of the result folder: meshes, simulator files and report.html, from what ``write_twin`` left (no dataset
    needed).

    log: told one line a step with its seconds.
    """
    from p2gs.export.formats import export_run
    from p2gs.export.pages.report import write_report
    from p2gs.surface.mesh import write_meshes

    run_dir = Path(run_dir)
    for name, step in (
        ("meshes", lambda: write_meshes(run_dir)),
        ("exports", lambda: export_run(run_dir, formats)),
        ("report", lambda: write_report(run_dir)),
    ):
        began = time.perf_counter()
        step()
        log(f"{name}: {time.perf_counter() - began:.1f} s")
