"""A part's surface, closed: which cells near it are solid is decided by votes and a cut, and what nobody saw is marked.

A mesh from photographs is a sheet that is open where nobody looked, and at the back of every wall of which one side
was seen. Every view votes, in the part's own frame, for free space up to the surface it sees and for solid just behind
it (the votes of both states, as in ``integrate``); what is guessed for unseen places votes for solid; things are
hollow, so what nobody saw leans to free. The least cut makes a solid of that (after Labatut et al. 2009, doi
10.1111/j.1467-8659.2009.01530.x, who cut Delaunay tetrahedra). Its boundary is closed, and where both sides of a cell
were seen it runs where the mean of the signed distances is zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh, components
from p2gs.surface.depth_view import DepthView, pixel_matrix, seen_points
from p2gs.surface.faces import Faces
from p2gs.surface.integrate import FREE_WEIGHT, integrate
from p2gs.surface.sightings import TRUNCATION
from p2gs.surface.simplify import collapsed
from p2gs.surface.tsdf import ActiveGrid, vertex_normals

# voxels behind a surface within which it counts (tsdf.fuse: the walls are thin), and to either side within which a
# point is on it
BEHIND = 1.5
HOLLOW = 0.3  # votes for free of a cell that nobody saw
FACE = 0.05  # votes that a voxel's face costs: a plate with less to say for it than for two of its faces goes
PIECE = 0.1  # share of the largest piece's cells below which a piece goes
# of TRUNCATION: how near to a cell's middle the surface may pass (no corner of a triangle lies on a cell), and by how
# much at most a cell that the cut has otherwise than its distance says is on the other side
CLEAR, OTHERWISE = 0.005, 0.05
# voxels: greatest quadric error (a sum over planes) of an edge that simplifying collapses; all but a thousandth of
# storage4's and fridge2's surfaces stay within half a voxel
ERROR = 2.0
FACES = 20_000  # triangles of a part, where ERROR allows
APART = 0.01  # voxels by which surfaces that touch are pulled apart: readers merge vertices of one place


@dataclass
class Cells:
    """What is known of cells around a part. origin [3]: middle of cell (0, 0, 0), side ``voxel``. By cell [X, Y, Z]:
    near, whether it was looked into; field, the mean of signed distances, in truncations; weight, of what went into it;
    sighted, of which that of views that see surface. colour [X, Y, Z, 3] in 0..1."""

    origin: np.ndarray
    voxel: float
    near: np.ndarray
    field: np.ndarray
    weight: np.ndarray
    sighted: np.ndarray

    @staticmethod
    def around(
        points: Sequence[Tensor], views: Sequence[DepthView], poses: Sequence[Tensor], part: int, voxel: float
    ) -> "Cells":
        """Those near points [n, 3] each, by all views of a part (as in ``tsdf.fuse``)."""
        grid = ActiveGrid.around(points, voxel)
        matrices = [pixel_matrix(v.camera, T) for v, T in zip(views, poses, strict=True)]
        field, sighted, _, weight = integrate(grid.centers(), views, matrices, part, TRUNCATION * voxel, BEHIND * voxel)
        at = tuple(grid.index.T.numpy())
        near, maps = np.zeros(grid.shape, bool), np.zeros((3, *grid.shape), np.float32)
        near[at] = True
        for volume, values in zip(maps, (field, torch.where(weight > 1e-6, weight, 0.0), sighted), strict=True):
            volume[at] = values.numpy()
        return Cells(grid.origin.numpy(), voxel, near, *maps)

    def holding(self, points: np.ndarray) -> np.ndarray:
        """The cells that hold points [N, 3], [X, Y, Z] bool."""
        out = np.zeros(self.near.shape, bool)
        at = np.round((points - self.origin) / self.voxel).astype(int)
        out[tuple(at[((at >= 0) & (at < out.shape)).all(1)].T)] = True
        return out

    def votes(self, beside: np.ndarray) -> np.ndarray:
        """Votes of the views, for solid where positive, [X, Y, Z]: of one that sees through half a vote, of many nearly
        a whole one. Those for solid count only ``beside`` [X, Y, Z] bool a surface that was found."""
        votes = -np.clip(TRUNCATION * self.field, -1, 1) * self.weight / (self.weight + FREE_WEIGHT)
        return np.where((self.weight == 0) | ((votes > 0) & ~beside), -HOLLOW, votes)


def close(
    seen: Mesh,
    done: Mesh,
    views: Sequence[DepthView],
    poses: Sequence[Tensor],
    part: int,
    voxel: float,
    max_faces: int = FACES,
) -> Mesh:
    """The closed surface of a part: watertight, facing outwards, with ``guessed`` faces where nobody saw a surface;
    simplified to ``max_faces`` as far as ``ERROR`` allows. Empty where there is none.

    seen: its surface as seen (``tsdf.fuse``).  done: the same, with guesses for unseen places, without what cannot be
    there.  views, poses, part, voxel: as in ``tsdf.fuse``.
    """
    if not len(done.faces):
        return Mesh.empty()
    kept, made = points_on(seen, voxel), points_on(done, voxel)
    points = [seen_points(v, part, T) for v, T in zip(views, poses, strict=True)]
    cells = Cells.around([*points, torch.as_tensor(made)], views, poses, part, voxel)
    before, after = cells.holding(kept), cells.holding(made)
    beside = _within(before, BEHIND)
    guess = after & (~beside | (cells.sighted == 0))  # up to the seen surface, without a gap
    solid = _solid(cells, beside, guess, before & ~_within(after, BEHIND))
    if not solid.any():
        return Mesh.empty()
    mesh = without_scraps(simplified(boundary(cells, solid, guess), ERROR * voxel, max_faces), voxel**3)
    mesh = pulled_apart(mesh, APART * voxel)
    colours = done.colours[search_tree(done.vertices).query(mesh.vertices)[1]]
    return replace(mesh, colours=colours, guessed=_unseen(mesh, cells))


def points_on(mesh: Mesh, step: float) -> np.ndarray:
    """Points [N, 3] on a mesh, no farther than about half a step from one another."""
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1) if len(corners) else np.zeros(0)
    parts = np.maximum(1, np.ceil(longest / (step / 2))).astype(int)
    out = [np.zeros((0, 3))]
    for n in np.unique(parts):
        i, j = (x.ravel() for x in np.mgrid[: n + 1, : n + 1])
        share = np.stack([i, j, n - i - j], 1)[i + j <= n] / n
        out.append((share @ corners[parts == n]).reshape(-1, 3))
    return np.concatenate(out)


def _within(cells: np.ndarray, reach: float) -> np.ndarray:
    """Cells [X, Y, Z] bool no farther than ``reach``, in cells, from those given."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(~cells)) <= reach if cells.any() else cells


def _solid(cells: Cells, beside: np.ndarray, guess: np.ndarray, gone: np.ndarray) -> np.ndarray:
    """Solid cells [X, Y, Z] bool, in large pieces, without voids that nobody saw. beside, guess, gone [X, Y, Z] bool:
    where surface was found, where it is guessed, and where it cannot be."""
    from p2gs.surface.cut import solid_cells

    votes = np.where(guess, 1.0, cells.votes(beside))
    free = _within(gone, BEHIND) & ~guess
    active = cells.near & ~free
    for axis in range(3):  # the border stays free, so that the solid ends before it
        for end in (0, -1):
            active[(slice(None),) * axis + (end,)] = False
    solid = solid_cells(votes, active, FACE)
    piece = _pieces(solid)
    count = np.bincount(piece.ravel())
    count[0] = 0
    solid &= (count >= PIECE * count.max())[piece]
    void = _pieces(~solid)
    looked_into = np.zeros(int(void.max()) + 1, bool)
    looked_into[void[~solid & (cells.field > 0.5) & (cells.weight > 0)]] = True
    looked_into[void[0, 0, 0]] = True  # the outside
    return solid | ~looked_into[void]


def _pieces(cells: np.ndarray) -> np.ndarray:
    """The connected piece of each of the cells [X, Y, Z] bool, from 1 on, 0 where there is none."""
    from scipy.ndimage import label

    found: Any = label(cells)
    return found[0].astype(np.int64)


def boundary(cells: Cells, solid: np.ndarray, guess: np.ndarray) -> Mesh:
    """The solid's surface: where the signed distance is zero, and half way between cells where nobody measured it."""
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    smooth = gaussian_filter(np.where(solid, -1.0, 1.0).astype(np.float32), 1.0) / TRUNCATION
    field = np.where((cells.sighted > 0) & ~guess, cells.field, smooth)
    distance = np.abs(field).clip(CLEAR, np.where((field < 0) == solid, 1.0, OTHERWISE))
    field = np.where(solid, -distance, distance)
    vertices, faces, _, _ = marching_cubes(field.astype(np.float32), 0.0, gradient_direction="descent")
    return Mesh(cells.origin + vertices.astype(np.float64) * cells.voxel, faces.astype(np.int64))


def simplified(mesh: Mesh, error: float, max_faces: int) -> Mesh:
    """A closed mesh, black, with at most about ``max_faces`` triangles, or as many as keep its surface within
    ``error``. Raises ValueError for one that has a hole (but for what simplifying shuts)."""
    import manifold3d

    middle = mesh.vertices.mean(0)  # manifold3d has float32
    fewer = collapsed(mesh, max_faces, error)
    shape = manifold3d.Mesh((fewer.vertices - middle).astype(np.float32), fewer.faces.astype(np.uint32))
    solid = manifold3d.Manifold(shape)  # where collapses made surfaces touch, they are taken apart
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"a mesh that is not closed cannot be simplified ({solid.status()})")
    out = solid.to_mesh()
    return Mesh(out.vert_properties[:, :3].astype(np.float64) + middle, out.tri_verts.astype(np.int64))


def without_scraps(mesh: Mesh, volume: float) -> Mesh:
    """A closed mesh without its pieces that enclose less than ``volume``, what collapses pinched off; the largest
    stays."""
    piece = components(mesh)
    a, b, c = ((mesh.vertices - mesh.vertices.mean(0))[mesh.faces[:, i]] for i in range(3))
    enclosed = np.bincount(piece, (a * np.cross(b, c)).sum(1)) / 6  # negative for a void
    return mesh.only((np.abs(enclosed) >= min(volume, enclosed.max()))[piece])


def pulled_apart(mesh: Mesh, distance: float) -> Mesh:
    """A closed mesh whose vertices of one place each went ``distance`` into the solid, away from one another."""
    _, place, count = np.unique(mesh.vertices, axis=0, return_inverse=True, return_counts=True)
    shared = (count > 1)[place.reshape(-1)]
    inward = -vertex_normals(mesh.vertices, mesh.faces)[shared]
    vertices = mesh.vertices.copy()
    vertices[shared] += distance * inward
    return replace(mesh, vertices=vertices)


def _unseen(mesh: Mesh, cells: Cells) -> np.ndarray:
    """Faces [F] bool before which no view saw surface: a voxel before a seen one there is a cell that it had a say
    in."""
    faces = Faces(mesh)
    at = np.round((faces.middle + cells.voxel * faces.normal - cells.origin) / cells.voxel).astype(int)
    return cells.sighted[tuple(at.clip(0, np.array(cells.near.shape) - 1).T)] == 0
