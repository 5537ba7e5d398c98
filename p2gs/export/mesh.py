"""RUN/meshes: the surface of every part and of the whole, at start and end, from the twin's own depth maps."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Optional, Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.export.paint import draw
from p2gs.export.pose import part_transform, pose
from p2gs.export.tsdf import DepthView, Mesh, add_normals, fuse, largest_components
from p2gs.export.twin_json import load_twin
from p2gs.export.views import NamedCamera, bounds, orbit, read_cameras
from p2gs.types import ArticulatedObject, Camera, GaussianTensors, UserError

STATES = ("start", "end")
RESOLUTION = 160  # voxels along the longest side of the object's box
VIEWS = 40  # a state
FEATURES = 16  # channels a rasterizer takes at once


def start_motion(obj: ArticulatedObject, part: int, t: float) -> Tensor:
    """Start state -> state t for the part, [4, 4] float64."""
    return part_transform(obj, part, t) @ torch.linalg.inv(part_transform(obj, part, 0.0))


def label_image(g: GaussianTensors, part_index: Tensor, parts: int, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Depth, labels, colour and alpha of one view; a pixel's label is the part that covers most of it, -1 where little is hit.

    part_index [N] in 0..parts-1.  depth [H, W]: where the transmittance passes one half, 0 elsewhere.
    """
    onehot = torch.nn.functional.one_hot(part_index, parts).float()
    out = draw(g, camera, 0.0, features=onehot[:, :FEATURES])
    more = onehot[:, FEATURES:].split(FEATURES, 1) if parts > FEATURES else ()
    shares = [out.features] + [draw(g, camera, 0.0, features=c).features for c in more]
    label = torch.cat(shares, -1).argmax(-1)
    solid = (out.alpha > 0.5) & (out.median_depth > 0)
    colour = out.colour / out.alpha.clamp_min(1e-3)[..., None]
    depth = torch.where(solid, out.median_depth, torch.zeros_like(out.median_depth))
    return depth, torch.where(solid, label, torch.full_like(label, -1)), colour.clamp(0, 1), out.alpha


def mesh_cameras(obj: ArticulatedObject, cameras: Sequence[NamedCamera], count: int = VIEWS) -> list[tuple[int, Camera]]:
    """(state, camera) to look from: the training views, at most ``count`` a state evenly taken; an orbit where there are none."""
    out = []
    for state in (0, 1):
        mine = [c.camera for c in cameras if c.state == state and c.split == "train"]
        if not mine:
            mine = [c for elevation in (-20.0, 15.0, 50.0) for c in orbit(obj, count // 3, elevation)]
        keep = np.unique(np.linspace(0, len(mine) - 1, min(count, len(mine))).round().astype(int))
        out += [(state, mine[i]) for i in keep]
    return out


def part_meshes(obj: ArticulatedObject, cameras: Sequence[tuple[int, Camera]], resolution: int = RESOLUTION) -> list[Mesh]:
    """The parts' surfaces in the start state, in the order of ``obj.parts``; an empty mesh where no view shows a part.

    obj and cameras ((state, camera) pairs) in one coordinate system. resolution: voxels along the longest side of the object.
    """
    lo, hi = bounds(obj, (0.0,))
    voxel = float((hi - lo).max()) / resolution
    index = torch.zeros(max(p.id for p in obj.parts) + 1, dtype=torch.int64)
    for k, part in enumerate(obj.parts):
        index[part.id] = k
    posed = [pose(obj, 0.0), pose(obj, 1.0)]
    views = []
    for state, camera in cameras:
        depth, label, colour, _ = label_image(posed[state], index[obj.part_ids], len(obj.parts), camera)
        views.append(add_normals(DepthView(camera, depth, label, colour), edge=2 * voxel))
    meshes = []
    for k in range(len(obj.parts)):
        motion = [start_motion(obj, k, 0.0), start_motion(obj, k, 1.0)]
        mesh = fuse(views, [motion[state] for state, _ in cameras], k, voxel, trunc=4 * voxel, behind=2 * voxel)
        meshes.append(largest_components(mesh))
    return meshes


def write_meshes(run_dir: Path | str, resolution: int = RESOLUTION, log=None) -> dict[str, list[Path]]:
    """RUN/meshes/{start,end}/{part_<id>,whole}.ply with vertex colours, input coordinates. Returns the paths by state.

    The whole is its parts joined, so that it has the surfaces that only the other state shows. Raises UserError without a twin.
    """
    run_dir = Path(run_dir)
    began = time.perf_counter()
    obj = load_twin(run_dir)
    meshes = part_meshes(obj, mesh_cameras(obj, read_cameras(run_dir / "cameras.json")), resolution)
    if not any(len(m.faces) for m in meshes):
        raise UserError(f"{run_dir}: the twin shows no surface from any of its cameras, so there is nothing to mesh")
    written: dict[str, list[Path]] = {}
    for t, state in enumerate(STATES):
        folder = run_dir / "meshes" / state
        folder.mkdir(parents=True, exist_ok=True)
        moved = [m.transformed(start_motion(obj, k, float(t)).numpy()) for k, m in enumerate(meshes)]
        written[state] = []
        for part, mesh in zip(obj.parts, moved, strict=True):
            written[state].append(write_mesh(folder / f"part_{part.id}.ply", mesh))
        written[state].append(write_mesh(folder / "whole.ply", Mesh.join(moved)))
    if log is not None:
        log(f"meshes: {sum(len(m.faces) for m in meshes):,} triangles in {time.perf_counter() - began:.1f} s")
    return written


def read_meshes(run_dir: Path | str, state: str = "start") -> Optional[list[Mesh]]:
    """The parts' meshes of a state in the order of twin.json; None where they have not been made."""
    obj_parts, folder = load_twin(run_dir).parts, Path(run_dir) / "meshes" / state
    if not folder.is_dir():
        return None
    return [read_mesh(folder / f"part_{p.id}.ply") for p in obj_parts]


VERTEX = np.dtype([(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
FACE = np.dtype([("n", "u1"), ("v", "<i4", 3)])


def write_mesh(path: Path, mesh: Mesh) -> Path:
    """Binary PLY with vertex colours."""
    vertices, faces = np.zeros(len(mesh.vertices), VERTEX), np.zeros(len(mesh.faces), FACE)
    for i, name in enumerate(("x", "y", "z")):
        vertices[name] = mesh.vertices[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        vertices[name] = mesh.colours[:, i]
    faces["n"], faces["v"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *(f"property float {n}" for n in "xyz")]
    lines += [f"property uchar {n}" for n in ("red", "green", "blue")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    path.write_bytes(("\n".join(lines) + "\n").encode() + vertices.tobytes() + faces.tobytes())
    return path


def read_mesh(path: Path) -> Mesh:
    """What ``write_mesh`` wrote."""
    data = Path(path).read_bytes()
    head, body = data.split(b"end_header\n", 1)
    counts = [int(line.split()[2]) for line in head.decode().splitlines() if line.startswith("element")]
    vertices = np.frombuffer(body, VERTEX, counts[0])
    faces = np.frombuffer(body, FACE, counts[1], offset=counts[0] * VERTEX.itemsize)
    xyz, rgb = (np.stack([vertices[n] for n in names], 1) for names in (("x", "y", "z"), ("red", "green", "blue")))
    return Mesh(xyz.astype(np.float64), faces["v"].astype(np.int64), rgb)
