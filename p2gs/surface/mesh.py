"""RUN/meshes: the surface of every part and of the whole, at start and end, from the twin's own depth maps."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Optional, Sequence

import numpy as np
import torch

from p2gs.gaussians.paint import rasterizer_of
from p2gs.gaussians.twin_json import load_twin
from p2gs.gaussians.views import NamedCamera, orbit, read_cameras
from p2gs.native import at_once
from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh
from p2gs.surface.bridges import bridged
from p2gs.surface.closed import FACES, close
from p2gs.surface.pieces import join_pieces
from p2gs.surface.protocol import largest_clusters, separate_whole, surface_options
from p2gs.surface.sightings import RESOLUTION, TRUNCATION, Sightings, sight, start_motion
from p2gs.surface.trays import clear_way, complete_tray, not_the_trays
from p2gs.surface.unseen import close_unseen_sides
from p2gs.types import ArticulatedObject, Camera, UserError

STATES = ("start", "end")
VIEWS = 64  # a state


def mesh_cameras(
    obj: ArticulatedObject, cameras: Sequence[NamedCamera], count: int = VIEWS
) -> list[tuple[int, Camera]]:
    """(state, camera) to look from: the training views, at most ``count`` a state evenly taken; an orbit where there
    are none."""
    out = []
    for state in (0, 1):
        mine = [c.camera for c in cameras if c.state == state and c.split == "train"]
        if not mine:
            mine = [c for elevation in (-20.0, 15.0, 50.0) for c in orbit(obj, count // 3, elevation)]
        keep = np.unique(np.linspace(0, len(mine) - 1, min(count, len(mine))).round().astype(int))
        out += [(state, mine[i]) for i in keep]
    return out


def part_meshes(
    obj: ArticulatedObject,
    cameras: Sequence[tuple[int, Camera]],
    resolution: int = RESOLUTION,
    complete: bool = True,
    closed: bool = True,
    max_faces: int = FACES,
) -> list[Mesh]:
    """The parts' surfaces in the start state, in the order of ``obj.parts``, an empty mesh where no view shows a part.

    ``guessed`` are the faces where nobody saw a surface: those that ``completed`` adds, and where it is ``closed``.

    obj and cameras ((state, camera) pairs) in one coordinate system. resolution: voxels along the longest side of the
    object.
    complete: off, there is only what was seen, and the meshes are open.  closed: watertight, with about ``max_faces``
    triangles each (``closed.close``).
    """
    seen = sight(obj, cameras, resolution)
    shown = seen.surfaces()
    if not complete:
        return shown
    done = completed(obj, seen, shown)
    if not closed:
        return [replace(b, guessed=_added(a, b)) for a, b in zip(shown, done, strict=True)]
    return at_once(
        lambda k: close(shown[k], done[k], seen.views, seen.poses[k], k, seen.voxel, max_faces), range(len(shown))
    )


def _added(shown: Mesh, done: Mesh) -> np.ndarray:
    """Faces [F] bool of ``done`` that ``shown`` does not have."""
    if not len(shown.faces) or not len(done.faces):
        return np.ones(len(done.faces), bool)
    middles = [m.vertices[m.faces].mean(1) for m in (shown, done)]
    return search_tree(middles[0]).query(middles[1])[0] > 0


def completed(obj: ArticulatedObject, seen: Sightings, shown: Sequence[Mesh]) -> list[Mesh]:
    """The parts' surfaces as ``shown``, open, with guesses for what nobody saw.

    Pieces that hang apart are joined to their part (``bridged``). The base's underside and other sides that no camera
    saw are closed (``close_unseen_sides``), drawers completed (``complete_tray``), with nothing of the base left in
    their way (``clear_way``) or of other parts on them (``not_the_trays``), and pieces of what slides joined
    (``join_pieces``).
    """
    voxel, meshes = seen.voxel, []
    for k, part in enumerate(obj.parts):
        mesh = bridged(shown[k], seen.views, seen.poses[k], voxel)
        if part.joint is None:
            mesh = close_unseen_sides(mesh, seen.views, seen.poses[k], k, voxel, TRUNCATION * voxel)
        meshes.append(mesh)
    base = next((k for k, p in enumerate(obj.parts) if p.joint is None and len(meshes[k].faces)), None)
    for k, part in enumerate(obj.parts):
        if part.joint is None or part.joint.type != "prismatic" or not len(meshes[k].faces):
            continue
        space = (seen.views, seen.poses[k], voxel)
        tray = None if base is None else seen.tray(k, meshes[k], meshes[base])
        if tray is not None and base is not None:
            meshes[k] = complete_tray(meshes[k], tray, *space, TRUNCATION * voxel)
            meshes[base] = clear_way(meshes[base], tray, voxel)
            for j in (j for j, p in enumerate(obj.parts) if p.joint is not None and j != k and len(meshes[j].faces)):
                place = torch.linalg.inv(seen.motions[k][tray.drawn]) @ seen.motions[j][tray.drawn]
                meshes[j] = not_the_trays(meshes[j], tray, place.numpy(), voxel)
        meshes[k] = join_pieces(meshes[k], part.joint.axis.numpy(), *space)
    return meshes


def write_meshes(run_dir: Path | str, resolution: int = RESOLUTION, log=None) -> dict[str, list[Path]]:
    """RUN/meshes/{start,end}/{part_<id>,whole}.ply with vertex colours, input coordinates. Returns the paths by state.

    The whole is its parts joined, so that it has the surfaces that only the other state shows, unless RUN/config.yaml
    wants another protocol (``protocol.SurfaceOptions``). Raises UserError without a twin.
    """
    run_dir = Path(run_dir)
    began = time.perf_counter()
    obj, options = load_twin(run_dir), surface_options(run_dir)
    if options.cluster > 0:
        obj = largest_clusters(obj, options.cluster)
    with rasterizer_of(run_dir):
        cameras = mesh_cameras(obj, read_cameras(run_dir / "cameras.json"))
        meshes = part_meshes(obj, cameras, resolution, options.complete, options.closed, options.max_faces)
        wholes = [separate_whole(obj, cameras, t, resolution) for t in (0, 1)] if options.whole == "separate" else None
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
        written[state].append(write_mesh(folder / "whole.ply", Mesh.join(moved) if wholes is None else wholes[t]))
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
FACE = np.dtype([("n", "u1"), ("v", "<i4", 3), ("guessed", "u1")])
OLD_FACE = np.dtype([("n", "u1"), ("v", "<i4", 3)])  # before faces said whether they are guessed


def write_mesh(path: Path, mesh: Mesh) -> Path:
    """Binary PLY with vertex colours and, by face, uchar ``guessed``: 1 where it closes what nobody saw."""
    vertices, faces = np.zeros(len(mesh.vertices), VERTEX), np.zeros(len(mesh.faces), FACE)
    for i, name in enumerate(("x", "y", "z")):
        vertices[name] = mesh.vertices[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        vertices[name] = mesh.colours[:, i]
    faces["n"], faces["v"], faces["guessed"] = 3, mesh.faces, mesh.guessed
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {n}" for n in "xyz"),
    ]
    lines += [f"property uchar {n}" for n in ("red", "green", "blue")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines += ["property uchar guessed", "end_header"]
    path.write_bytes(("\n".join(lines) + "\n").encode() + vertices.tobytes() + faces.tobytes())
    return path


def read_mesh(path: Path) -> Mesh:
    """What ``write_mesh`` wrote. Raises UserError for anything else."""
    data = Path(path).read_bytes()
    head, _, body = data.partition(b"end_header\n")
    try:
        counts = [int(line.split()[2]) for line in head.decode().splitlines() if line.startswith("element")]
        vertices = np.frombuffer(body, VERTEX, counts[0])
        kind = FACE if b"property uchar guessed" in head else OLD_FACE
        faces = np.frombuffer(body, kind, counts[1], offset=counts[0] * VERTEX.itemsize)
        if min(counts) < 0 or (len(faces) and (faces["v"].min() < 0 or faces["v"].max() >= len(vertices))):
            raise ValueError("a face has a vertex that is not there")
    except (ValueError, IndexError, OverflowError) as err:
        raise UserError(
            f"{path} is no mesh of p2gs, or is cut short ({err}); p2gs export RUN --format ply writes it anew"
        ) from err
    xyz, rgb = (np.stack([vertices[n] for n in names], 1) for names in (("x", "y", "z"), ("red", "green", "blue")))
    guessed = faces["guessed"] > 0 if kind is FACE else np.zeros(len(faces), bool)
    return Mesh(xyz.astype(np.float64), faces["v"].astype(np.int64), rgb, guessed)
