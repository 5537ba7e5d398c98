"""What is fuzzed: a folder of sound files made once, and a function that reads them.

Reading a damaged folder may succeed or raise UserError; anything else is a fault. What two readers say of one folder
must agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Callable

import numpy as np
import torch

from p2gs.types import UserError


@dataclass
class Target:
    """make: write the sound files into a folder.  read: read them all.  share: of the mutants."""

    make: Callable[[Path], None]
    read: Callable[[Path], None]
    share: int


def _scene(format: str) -> Target:
    def make(folder: Path) -> None:
        from p2gs.data.generated.synthetic import make_object
        from p2gs.data.generated.write import write_scene

        write_scene(make_object("lid_box", 1), folder, format, 32, 3, 1, seed=5)

    def read(folder: Path) -> None:
        from p2gs.data.check import check_dataset
        from p2gs.data.modules import DATASETS

        errors = [f.message for f in check_dataset(folder, format) if f.level == "error"]
        assert not any("\n" in e for e in errors), "an error of several lines"
        try:
            scene = DATASETS[format](root=str(folder)).scene()
            assert torch.isfinite(scene.box).all() and all(torch.isfinite(v.camera.viewmat).all() for v in scene.views)
        except UserError as err:
            assert errors, f"data check finds nothing, but the reader says: {err}"
        else:
            assert not errors, f"the reader is content, but data check says: {errors[0]}"

    return Target(make, read, 3)


CONFIG = """
include: [preset/cpu.yaml, other.yaml]
run: out
seed: 3
num_parts: 3
data: {format: artgs, root: scene, max_views: 8, depth: never}
phases:
  single_state:
    steps: 100
    levels: [50, 100]
    losses: {alpha: null, render: {weight: 1.0, ssim_lambda: 0.2}}
    callbacks: {densify: {budget: 500}}
  discovery: {evidence_size: 64}
callbacks: {progress: {every_seconds: 1.0}, viewer: null}
plugins: []
"""


def _make_config(folder: Path) -> None:
    (folder / "user.yaml").write_text(CONFIG)
    (folder / "other.yaml").write_text("phases: {articulation: {steps: 7}}\n")


def _read_config(folder: Path) -> None:
    from p2gs.config.run import load_config, save_config

    config = load_config([str(folder / "user.yaml")])
    save_config(config, folder / "saved.yaml")
    again = load_config([str(folder / "saved.yaml")])
    assert again.to_dict() == config.to_dict(), "what save_config wrote reads differently"
    (folder / "saved.yaml").unlink()


def _make_run(folder: Path) -> None:
    from toy import toy_scene, toy_twin

    from p2gs.gaussians.splat_ply import write_splat_ply
    from p2gs.gaussians.twin_json import write_twin_json
    from p2gs.gaussians.views import scene_cameras, write_cameras
    from p2gs.surface.mesh import Mesh, write_mesh

    obj = toy_twin()
    write_splat_ply(folder / "splats" / "canonical.ply", obj.gaussians, obj.part_ids)
    write_twin_json(obj, folder / "twin.json")
    write_cameras(folder / "cameras.json", scene_cameras(toy_scene(n=2, size=16)))
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    write_mesh(folder / "part_0.ply", Mesh(corners, faces, np.full((4, 3), 128, np.uint8)))
    (folder / "config.yaml").write_text("rasterizer: auto\nphases: {finish: {complete: true}}\n")


def _read_run(folder: Path) -> None:
    from p2gs.gaussians.paint import run_rasterizer
    from p2gs.gaussians.twin_json import load_twin
    from p2gs.gaussians.views import read_cameras
    from p2gs.surface.mesh import read_mesh
    from p2gs.surface.protocol import surface_options

    for read, path in (
        (load_twin, folder),
        (read_cameras, folder / "cameras.json"),
        (run_rasterizer, folder),
        (surface_options, folder),
    ):
        try:
            made = read(path)
        except UserError:
            continue
        if read is load_twin:
            assert torch.isfinite(made.gaussians.means).all() and int(made.part_ids.max()) < len(made.parts)
    if (folder / "part_0.ply").is_file():
        mesh = read_mesh(folder / "part_0.ply")
        assert len(mesh.faces) == 0 or mesh.faces.max() < len(mesh.vertices)


def _make_checkpoint(folder: Path) -> None:
    from p2gs.gaussians import handover
    from p2gs.types import GaussianTensors

    n = 50
    values = torch.arange(n * 3.0).reshape(n, 3)
    g = GaussianTensors(values, torch.ones(n, 4), values, values[:, 0], values[:, None])
    handover.save(handover.StateGaussians(1, g), folder / "single_state_1.pt", key="k")


def _read_checkpoint(folder: Path) -> None:
    """Every change is noticed: the checksum is of all bytes."""
    from p2gs.gaussians import handover
    from p2gs.gaussians.sealed import Damaged

    path = folder / "single_state_1.pt"
    try:
        handover.load(path)
    except (Damaged, FileNotFoundError, IsADirectoryError):
        return
    except OSError as err:
        assert "symbolic links" in str(err), err
        return
    raise AssertionError("a changed checkpoint was loaded")


def _poses(text: bool) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        if text:
            (folder / "cameras.txt").write_text("# cameras\n1 PINHOLE 400 300 350.5 350.5 200 150\n")
            rows = [f"{i} 1 0 0 {i / 10} 0 0 4 1 start/{i:03d}.jpg\n{10 * i} 20.5 {i} 40 50 -1\n" for i in range(1, 5)]
            (folder / "images.txt").write_text("".join(rows))
            (folder / "points3D.txt").write_text("".join(f"{i} 0.1 {i} 0.3 200 100 50 0.5 1 2\n" for i in range(1, 5)))
            return
        pose = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
        frames = ", ".join(f'{{"file_path": "start/{i}.jpg", "transform_matrix": {pose}}}' for i in range(3))
        lens = '"fl_x": 350, "fl_y": 351, "cx": 200, "cy": 150, "w": 400, "h": 300, "k1": 0.01'
        (folder / "transforms.json").write_text(f'{{{lens}, "applied_transform": {pose[:3]}, "frames": [{frames}]}}')

    return make


def _make_binary(folder: Path) -> None:
    from p2gs.data.capture.colmap_io import read_model, write_model

    _poses(text=True)(folder)
    write_model(read_model(folder), folder)
    for name in ("cameras", "images", "points3D"):
        (folder / f"{name}.txt").unlink()


def _read_poses(folder: Path) -> None:
    from p2gs.data.capture.poses import read_poses

    model = read_poses(folder)
    assert all(np.isfinite(p.viewmat).all() for p in model.photos.values())


TARGETS = {
    "artgs": _scene("artgs"),
    "dta": _scene("dta"),
    "paris": _scene("paris"),
    "config": Target(_make_config, _read_config, 4),
    "run": Target(_make_run, _read_run, 4),
    "checkpoint": Target(_make_checkpoint, _read_checkpoint, 2),
    "colmap_text": Target(_poses(text=True), _read_poses, 1),
    "colmap_binary": Target(_make_binary, _read_poses, 1),
    "transforms": Target(_poses(text=False), _read_poses, 1),
}
