"""Depth maps of a rigid part, fused into a truncated signed distance field and cut by marching cubes.

Each part has its own volume in its start-state pose; views of every state are brought there by the part's motion, so that what
one state hides another shows. Voxels are kept only near seen surface. Curless and Levoy (1996), doi 10.1145/237170.237269, with
point-to-plane distances: the difference in depth times the cosine between ray and surface normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional, Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.types import Camera

BLOCK = 4  # voxels; active space is kept in cubes of this side
CHUNK = 1 << 16  # voxels
FREE_WEIGHT = 0.3  # of a view that sees through a voxel, against 1 of a view that sees surface in it head-on and for sure


@dataclass
class DepthView:
    """What one view saw.

    depth [H, W] along z, 0 where nothing was hit.  labels [H, W] int64 part id, -1 where nothing.  colour [H, W, 3] in 0..1.
    """

    camera: Camera
    depth: Tensor
    labels: Tensor
    colour: Tensor
    normal_dot: Optional[Tensor] = None  # [H, W] |n . ray| for a ray of unit z; distance to the surface's plane per unit of depth
    cosine: Optional[Tensor] = None  # [H, W] weight of the sighting: between ray and normal, 0 where the depth has an edge


@dataclass
class Mesh:
    """vertices [V, 3] float64, faces [F, 3] int64, colours [V, 3] uint8."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray

    def transformed(self, T: np.ndarray) -> "Mesh":
        return Mesh(self.vertices @ T[:3, :3].T + T[:3, 3], self.faces, self.colours)

    def without_unused(self) -> "Mesh":
        """Without vertices that no triangle has."""
        used, renumbered = np.unique(self.faces, return_inverse=True)
        return Mesh(self.vertices[used], renumbered.reshape(-1, 3), self.colours[used])

    @staticmethod
    def join(meshes: Sequence["Mesh"]) -> "Mesh":
        offsets = np.cumsum([0] + [len(m.vertices) for m in meshes])
        faces = [m.faces + o for m, o in zip(meshes, offsets, strict=False)]
        return Mesh(*(np.concatenate(x) for x in ([m.vertices for m in meshes], faces, [m.colours for m in meshes])))

    @staticmethod
    def empty() -> "Mesh":
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))


def camera_rays(camera: Camera) -> Tensor:
    """Directions of unit z through the pixel centres, camera coordinates, [H, W, 3] float32."""
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], -1).double()
    return (pixels @ torch.linalg.inv(camera.K.double()).T).float()


def add_normals(view: DepthView, edge: float) -> DepthView:
    """Fill ``normal_dot`` and ``cosine`` from the depth map. edge: neighbours further apart in depth than this are another surface."""
    rays = camera_rays(view.camera)
    p, d = rays * view.depth[..., None], view.depth
    pad = torch.nn.functional.pad(p.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    dx, dy = pad[1:-1, 2:] - pad[1:-1, :-2], pad[2:, 1:-1] - pad[:-2, 1:-1]
    n = torch.nn.functional.normalize(torch.linalg.cross(dx, dy), dim=-1)
    dot = (n * rays).sum(-1).abs()
    # a plane seen at an angle changes depth too: an edge is where both neighbours are off the straight line between them
    near = torch.nn.functional.pad(d[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    bend = torch.maximum((near[1:-1, 2:] + near[1:-1, :-2] - 2 * d).abs(), (near[2:, 1:-1] + near[:-2, 1:-1] - 2 * d).abs())
    hole = (near[1:-1, 2:] == 0) | (near[1:-1, :-2] == 0) | (near[2:, 1:-1] == 0) | (near[:-2, 1:-1] == 0)
    cosine = dot / rays.norm(dim=-1)
    view.normal_dot, view.cosine = dot, torch.where((bend > edge) | hole | (d == 0) | (cosine < 0.1), torch.zeros_like(dot), cosine)
    return view


def seen_points(view: DepthView, part: int, start_to_world: Tensor, stride: int = 1) -> Tensor:
    """Where the view saw the part, in the part's start-state coordinates, [M, 3] float64."""
    mask = (view.labels == part) & (view.cosine > 0)
    if stride > 1:
        keep = torch.zeros_like(mask)
        keep[::stride, ::stride] = True
        mask &= keep
    x = (camera_rays(view.camera)[mask] * view.depth[mask][:, None]).double()
    M = view.camera.viewmat.double() @ start_to_world
    return (x - M[:3, 3]) @ M[:3, :3]


def fuse(views: Sequence[DepthView], poses: Sequence[Tensor], part: int, voxel: float, trunc: float, behind: float) -> Mesh:
    """The part's surface in its start-state pose.

    views: all views, with normals.  poses: start-state coordinates -> world, [4, 4] each.  voxel: side.  trunc: distance in front
    of the surface at which space counts as free.  behind: how far behind the surface it still counts (keeps thin panels apart).
    """
    points = [seen_points(v, part, T) for v, T in zip(views, poses, strict=True)]
    points = torch.cat(points)
    if len(points) < 50:
        return Mesh.empty()
    grid = ActiveGrid.around(points, voxel)
    maps = [_pixel_table(v, part) for v in views]
    matrices = [pixel_matrix(v.camera, T).float() for v, T in zip(views, poses, strict=True)]
    chunks = grid.centers().split(CHUNK)  # small enough to stay in cache through all views
    field, weight, colour = (torch.cat(x) for x in zip(*(_integrate(x, views, maps, matrices, trunc, behind) for x in chunks), strict=True))
    return grid.surface(field, weight > 0, colour)


def pixel_matrix(camera: Camera, T: Tensor) -> Tensor:
    """[3, 4] float64: coordinates that the pose T [4, 4] carries to the world -> pixels times depth."""
    return camera.K.double() @ (camera.viewmat.double() @ T)[:3]


def pixels(columns: Tensor, M: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth [n] and flat pixel [n] of points [3, n] under ``pixel_matrix`` M; the pixel is H W outside the image."""
    width, height = camera.width, camera.height
    p = torch.addmm(M[:, 3:], M[:, :3], columns)
    z = p[2]
    u, v = p[:2] / z.clamp_min(1e-6)
    pixel = v.clamp(0, height - 1).long() * width + u.clamp(0, width - 1).long()
    outside = (z < 1e-4) | (u < 0) | (v < 0) | (u >= width) | (v >= height)
    return z, pixel.masked_fill_(outside, width * height)


def _pixel_table(view: DepthView, part: int) -> Tensor:
    """[H W + 1, 6] float32 a pixel: depth (1e9 where nothing is), |n . ray|, cosine on this part (else 0), RGB. The last row: outside."""
    depth = torch.where(view.labels < 0, torch.full_like(view.depth, 1e9), view.depth)
    cosine = torch.where(view.labels == part, view.cosine, torch.zeros_like(view.cosine))
    table = torch.cat([depth[..., None], view.normal_dot.clamp_min(0.05)[..., None], cosine[..., None], view.colour], -1).reshape(-1, 6)
    return torch.cat([table, torch.tensor([[-1e9, 1.0, 0, 0, 0, 0]])])


def _integrate(x: Tensor, views, maps, matrices, trunc: float, behind: float) -> tuple[Tensor, Tensor, Tensor]:
    """Signed distance in units of trunc [n], weight of surface sightings [n] and colour [n, 3] at points x [n, 3]."""
    total, weight = torch.zeros(len(x)), torch.full((len(x),), 1e-9)
    tint = torch.full((len(x), 4), 1e-9)
    columns = x.T.contiguous()
    for view, table, M in zip(views, maps, matrices, strict=True):
        z, pixel = pixels(columns, M, view.camera)
        row = table.index_select(0, pixel)
        gap = row[:, 0] - z
        d = gap * row[:, 1]
        free = (gap > trunc) & (d > 0.5 * trunc)
        near = (~free & (d > -behind)) * row[:, 2]
        w = torch.where(free, FREE_WEIGHT, near)
        weight += w
        total += w * (d / trunc).clamp_(-1, 1).masked_fill_(free, 1.0)
        # colour from sightings right at the voxel: those of a thin wall's other side are only a few voxels away
        near *= (d < trunc) * torch.exp(-((4 * d / trunc) ** 2)).clamp_min_(1e-4)
        tint[:, 0] += near
        tint[:, 1:] += near[:, None] * row[:, 3:]
    seen = tint[:, 0]
    return total / weight, torch.where(seen > 1e-7, seen, torch.zeros_like(seen)), tint[:, 1:] / seen[:, None]


@dataclass
class ActiveGrid:
    """Voxels near seen surface. origin [3] float64: centre of voxel (0, 0, 0); index [M, 3] int64."""

    origin: Tensor
    voxel: float
    shape: tuple[int, int, int]
    index: Tensor

    @staticmethod
    def around(points: Tensor, voxel: float) -> "ActiveGrid":
        """All voxels of the blocks that hold a point, and of the blocks beside them."""
        side = BLOCK * voxel
        lo = points.amin(0) - 1.5 * side
        blocks = ((points - lo) / side).floor().long()
        dims = (blocks.amax(0) + 2).tolist()
        hit = torch.zeros(dims, dtype=torch.float32)
        hit[blocks[:, 0], blocks[:, 1], blocks[:, 2]] = 1
        grown = torch.nn.functional.max_pool3d(hit[None, None], 3, stride=1, padding=1)[0, 0]
        blocks = grown.nonzero()
        inner = torch.stack(torch.meshgrid(*(torch.arange(BLOCK),) * 3, indexing="ij"), -1).reshape(-1, 3)
        index = (blocks[:, None] * BLOCK + inner).reshape(-1, 3)
        return ActiveGrid(lo, voxel, tuple(d * BLOCK for d in dims), index)

    def centers(self) -> Tensor:
        """[M, 3] float32."""
        return (self.origin + self.index.double() * self.voxel).float()

    def surface(self, field: Tensor, seen: Tensor, colour: Tensor) -> Mesh:
        """Zero crossing of field [M] over the cells whose eight corners are seen [M]; colours [M, 3] in 0..1 carried along."""
        from scipy.ndimage import map_coordinates
        from scipy.spatial import cKDTree
        from skimage.measure import marching_cubes

        i = tuple(self.index[seen].T.numpy())
        dense = np.ones(self.shape, np.float32)
        known = np.zeros(self.shape, bool)
        dense[i], known[i] = field[seen].numpy(), True
        dense, known = fill_pinholes(dense, known)
        cell = known.copy()  # cell[x+1, y+1, z+1]: all corners x..x+1 known, which is where marching_cubes looks for its mask
        for axis in range(3):
            a, b = [slice(None)] * 3, [slice(None)] * 3
            a[axis], b[axis] = slice(1, None), slice(None, -1)
            shifted = np.zeros_like(cell)
            shifted[tuple(a)] = cell[tuple(a)] & cell[tuple(b)]
            cell = shifted
        if not cell.any() or dense[known].min() >= 0 or dense[known].max() <= 0:
            return Mesh.empty()
        vertices, faces, _, _ = marching_cubes(
            dense, 0.0, mask=cell, gradient_direction="descent"
        )  # faces look to where the field is positive
        rgb = np.zeros((len(vertices), 4))
        for c in range(4):
            volume = np.zeros(self.shape, np.float32)
            volume[i] = colour[seen, c].numpy() if c < 3 else 1.0
            rgb[:, c] = map_coordinates(volume, vertices.T, order=1, mode="nearest")
        painted = rgb[:, 3] > 1e-6  # not where pinholes were filled
        rgb = rgb[:, :3] / np.maximum(rgb[:, 3:], 1e-6)
        if painted.any() and not painted.all():
            rgb[~painted] = rgb[painted][cKDTree(vertices[painted]).query(vertices[~painted])[1]]
        world = self.origin.numpy() + vertices.astype(np.float64) * self.voxel
        return Mesh(world, faces.astype(np.int64), (np.clip(rgb, 0, 1) * 255).round().astype(np.uint8))


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted, [V, 3] unit."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal, face = np.zeros_like(vertices), np.cross(b - a, c - a)
    for i in range(3):
        for axis in range(3):
            normal[:, axis] += np.bincount(faces[:, i], face[:, axis], len(vertices))
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(length > 0, normal / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


def fill_pinholes(field: np.ndarray, known: np.ndarray, enough: float = 14 / 27, rounds: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Give unknown voxels that most neighbours surround (at least ``enough`` of the 3^3 cube) the known ones' mean.

    Beyond the rim of an open surface a voxel has at most 9 known neighbours, so openings do not shrink.
    """
    from scipy.ndimage import uniform_filter

    for _ in range(rounds):
        share = uniform_filter(known.astype(np.float32), 3, mode="constant")
        mean = uniform_filter(np.where(known, field, 0).astype(np.float32), 3, mode="constant") / np.maximum(share, 1e-6)
        new = ~known & (share > enough - 1e-3)
        field, known = np.where(new, mean, field), known | new
    return field, known


def largest_components(mesh: Mesh, fraction: float = 0.1) -> Mesh:
    """Without the connected components that have fewer than ``fraction`` of the largest one's triangles."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(mesh.faces):
        return mesh
    f, n = mesh.faces, len(mesh.vertices)
    graph = coo_matrix((np.ones(2 * len(f)), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]])), (n, n))
    label = connected_components(graph, directed=False)[1][f[:, 0]]
    count = np.bincount(label)
    keep = f[count[label] >= fraction * count.max()]
    return Mesh(mesh.vertices, keep, mesh.colours).without_unused()
