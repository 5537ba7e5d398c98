"""RUN/meshes: the surface of every part and of the whole, at start and end, from the twin's own depth maps."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Optional, Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.export.depth_view import DepthView, add_normals
from p2gs.export.paint import draw, rasterizer_of
from p2gs.export.pieces import join_pieces
from p2gs.export.pose import part_transform, pose
from p2gs.export.surface_depth import surface_depth
from p2gs.export.trays import clear_way, complete_tray, find_tray, not_the_trays
from p2gs.export.tsdf import Mesh, fuse, largest_components
from p2gs.export.twin_json import load_twin
from p2gs.export.unseen import close_unseen_sides, eyes_of
from p2gs.export.views import NamedCamera, bounds, orbit, read_cameras
from p2gs.ops.blend import likeliest
from p2gs.render.base import MAX_FEATURES
from p2gs.types import ArticulatedObject, Camera, GaussianTensors, UserError

STATES = ("start", "end")
RESOLUTION = 160  # voxels along the longest side of the object's box
VIEWS = 64  # a state
FIRM = 0.8  # opacity a ray must meet to count as a sighting of surface
FOG = 2.5  # times the usual spread of depth along a ray: what is more is fog
NEAR = 0.02  # of the object's longest side: see look and fog_limit
EDGE, TRUNCATION, BEHIND = 2.0, 4.0, 2.0  # voxels: see tsdf.add_normals and tsdf.fuse


def start_motion(obj: ArticulatedObject, part: int, t: float) -> Tensor:
    """Start state -> state t for the part, [4, 4] float64."""
    return part_transform(obj, part, t) @ torch.linalg.inv(part_transform(obj, part, 0.0))


@dataclass
class PartView:
    """What a camera sees of a twin. depth [H, W] along z, 0 where little is hit.  label [H, W] int64: the part that covers most of a
    pixel, -1 where little is hit.  colour [H, W, 3] in 0..1.  alpha [H, W].  spread [H, W]: see ``surface_depth``."""

    depth: Tensor
    label: Tensor
    colour: Tensor
    alpha: Tensor
    spread: Tensor


def look(g: GaussianTensors, part_index: Tensor, parts: int, camera: Camera, near: float) -> PartView:
    """Draw the parts. part_index [N] in 0..parts-1.

    near: where what a ray meets lies within this, as a standard deviation, it is one surface (``surface_depth``). Where it is not, the ray
    meets two, the mean of which lies on neither: the depth is then that at which transmittance passes one half.
    """
    onehot = torch.nn.functional.one_hot(part_index, parts).float()
    out = draw(g, camera, 0.0, features=onehot[:, :MAX_FEATURES])
    more = onehot[:, MAX_FEATURES:].split(MAX_FEATURES, 1) if parts > MAX_FEATURES else ()
    shares = [out.features] + [draw(g, camera, 0.0, features=c).features for c in more]
    median = out.expected_depth if out.median_depth is None else out.median_depth  # gsplat gives none
    depth, spread = surface_depth(g, camera)
    solid = (out.alpha > 0.5) & (median > 0)
    alpha = out.alpha.clamp_min(1e-3)
    return PartView(
        depth=torch.where(solid, torch.where((depth > 0) & (spread < near), depth, median), torch.zeros_like(depth)),
        label=torch.where(solid, likeliest(torch.cat(shares, -1).flatten(0, 1)).reshape(solid.shape), -1),
        colour=(out.colour / alpha[..., None]).clamp(0, 1),
        alpha=out.alpha,
        spread=spread,
    )


def fog_limit(looks: Sequence[PartView], size: float) -> float:
    """Spread beyond which a ray has met fog: ``FOG`` times what is usual in this twin, as a coarse one is loose everywhere; at least a
    fiftieth of its longest side ``size``."""
    solid = [v.spread[v.alpha > FIRM] for v in looks]
    spread = torch.cat(solid) if solid else torch.zeros(0)
    return max(FOG * float(spread.median()) if len(spread) else 0.0, NEAR * size)


def trust(seen: PartView, limit: float) -> Tensor:
    """[H, W] in 0..1, how much a pixel's depth says of a surface. limit: see ``fog_limit``.

    Fog covers a pixel poorly or is spread along its ray: no surface may come of it (it still hides nothing that others see before it).
    """
    firm = (seen.alpha > FIRM) & (seen.spread < limit)
    return firm / (1 + (2 * seen.spread / limit) ** 2)


def beside_others(label: Tensor) -> Tensor:
    """Pixels [H, W] bool beside those of another label: what they saw may be a mean of both."""
    x = label[None, None].float()
    return (torch.nn.functional.max_pool2d(x, 3, 1, 1) != -torch.nn.functional.max_pool2d(-x, 3, 1, 1))[0, 0]


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


@dataclass
class Sightings:
    """What cameras see of a twin's parts. size: of its longest side.  views: labelled by place in ``obj.parts``.  motions: of each
    part, start state -> start and end.  poses: of each part, one a view."""

    size: float
    views: list[DepthView]
    motions: list[list[Tensor]]
    poses: list[list[Tensor]]


def sight(obj: ArticulatedObject, cameras: Sequence[tuple[int, Camera]], resolution: int = RESOLUTION) -> Sightings:
    """Look at the parts. obj and cameras ((state, camera) pairs) in one coordinate system. resolution: as in ``part_meshes``."""
    lo, hi = bounds(obj, (0.0,))
    size = float((hi - lo).max())
    index = torch.zeros(max(p.id for p in obj.parts) + 1, dtype=torch.int64)
    for k, part in enumerate(obj.parts):
        index[part.id] = k
    posed = [pose(obj, 0.0), pose(obj, 1.0)]
    looks = [look(posed[state], index[obj.part_ids], len(obj.parts), camera, near=NEAR * size) for state, camera in cameras]
    limit = fog_limit(looks, size)
    views = []
    for seen, (_, camera) in zip(looks, cameras, strict=True):
        view = add_normals(DepthView(camera, seen.depth, seen.label, seen.colour), edge=EDGE * size / resolution)
        view.cosine = view.cosine * trust(seen, limit) * ~beside_others(seen.label)
        views.append(view)
    motions = [[start_motion(obj, k, 0.0), start_motion(obj, k, 1.0)] for k in range(len(obj.parts))]
    return Sightings(size, views, motions, [[motion[state] for state, _ in cameras] for motion in motions])


def part_meshes(obj: ArticulatedObject, cameras: Sequence[tuple[int, Camera]], resolution: int = RESOLUTION) -> list[Mesh]:
    """The parts' surfaces in the start state, in the order of ``obj.parts``; an empty mesh where no view shows a part.  The base's
    underside and other sides that no camera saw are closed (``close_unseen_sides``), drawers completed (``complete_tray``), with nothing of
    the base left in their way (``clear_way``) or of other parts on them (``not_the_trays``), and pieces of what slides joined
    (``join_pieces``).

    obj and cameras ((state, camera) pairs) in one coordinate system. resolution: voxels along the longest side of the object.
    """
    seen = sight(obj, cameras, resolution)
    voxel = seen.size / resolution
    meshes = []
    for k, part in enumerate(obj.parts):
        mesh = largest_components(fuse(seen.views, seen.poses[k], k, voxel, trunc=TRUNCATION * voxel, behind=BEHIND * voxel))
        if part.joint is None:
            mesh = close_unseen_sides(mesh, seen.views, seen.poses[k], k, voxel, TRUNCATION * voxel)
        meshes.append(mesh)
    base = next((k for k, p in enumerate(obj.parts) if p.joint is None and len(meshes[k].faces)), None)
    for k, part in enumerate(obj.parts):
        if part.joint is None or part.joint.type != "prismatic" or not len(meshes[k].faces):
            continue
        space = (seen.views, seen.poses[k], voxel)
        tray = None
        if base is not None:
            tray = find_tray(meshes[k], meshes[base], seen.motions[k][1].numpy(), eyes_of(*space[:2]), voxel)
        if tray is not None:
            meshes[k] = complete_tray(meshes[k], tray, *space, TRUNCATION * voxel)
            meshes[base] = clear_way(meshes[base], tray, voxel)
            for j in (j for j, p in enumerate(obj.parts) if p.joint is not None and j != k and len(meshes[j].faces)):
                place = torch.linalg.inv(seen.motions[k][tray.drawn]) @ seen.motions[j][tray.drawn]
                meshes[j] = not_the_trays(meshes[j], tray, place.numpy(), voxel)
        meshes[k] = join_pieces(meshes[k], part.joint.axis.numpy(), *space)
    return meshes


def write_meshes(run_dir: Path | str, resolution: int = RESOLUTION, log=None) -> dict[str, list[Path]]:
    """RUN/meshes/{start,end}/{part_<id>,whole}.ply with vertex colours, input coordinates. Returns the paths by state.

    The whole is its parts joined, so that it has the surfaces that only the other state shows. Raises UserError without a twin.
    """
    run_dir = Path(run_dir)
    began = time.perf_counter()
    obj = load_twin(run_dir)
    with rasterizer_of(run_dir):
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
