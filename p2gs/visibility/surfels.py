"""Oriented surface points from a state's depth maps, averaged over views, with floaters and flying pixels removed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from p2gs.ops.knn import search_tree
from p2gs.ops.robust import MEDIAN_SIGMA
from p2gs.visibility.depth_stack import DepthStack, StateEvidence


@dataclass(eq=False)
class Surfels:
    """points [N, 3]; normals [N, 3] unit, towards the cameras; colours [N, 3]; spacing: median distance to the 4th
    neighbour; noise: robust standard deviation of the depth maps about the surfels, along the normal (scene units)."""

    points: Tensor
    normals: Tensor
    colours: Tensor
    spacing: float
    noise: float

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def tree(self) -> cKDTree:
        """k-d tree of the points, built when it is first asked for."""
        return search_tree(self.points.numpy())

    def nearest(self, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Distances [N, k] (float64) and indices [N, k] of the k surfels nearest to points [N, 3], nearest first; of
        all where there are fewer."""
        k = min(k, len(self))
        d, j = self.tree.query(points.detach().cpu().float().numpy(), k=k)
        return torch.from_numpy(np.reshape(d, (len(points), k))), torch.from_numpy(np.reshape(j, (len(points), k)))

    def __getitem__(self, index) -> "Surfels":
        return Surfels(self.points[index], self.normals[index], self.colours[index], self.spacing, self.noise)


def window_planes(
    stack: DepthStack, view: Tensor, y: Tensor, x: Tensor, reach: float, radius: int = 2, block: int = 8192
):
    """Plane through the (2r+1)^2 pixels about each given pixel, pixels farther than ``reach`` in depth faded out.

    Returns point [M, 3] (the pixel's ray cut with the plane's mean depth) and normal [M, 3] towards the camera, both in
    world coordinates, support [M] (pixels) and cosine [M] between normal and ray. Solved as a weighted regression of
    inverse depth, which is exact for a plane seen in perspective.
    block: pixels at a time, so that what lies between stays in the caches.
    """
    if len(view) > block:
        parts = [
            window_planes(stack, *p, reach, radius, block)
            for p in zip(view.split(block), y.split(block), x.split(block), strict=True)
        ]
        return tuple(torch.cat(p) for p in zip(*parts, strict=True))
    H, W = stack.depth.shape[1:]
    o = torch.arange(-radius, radius + 1)
    dy, dx = [g.reshape(-1) for g in torch.meshgrid(o, o, indexing="ij")]
    yy, xx = y[:, None] + dy, x[:, None] + dx
    inside = (yy >= 0) & (yy < H) & (xx >= 0) & (xx < W)
    flat = (view[:, None] * H + yy.clamp(0, H - 1)) * W + xx.clamp(0, W - 1)
    z = stack.depth.reshape(-1)[flat]
    z0 = stack.depth[view, y, x][:, None]
    w = (inside & stack.valid.reshape(-1)[flat]).float() * torch.exp(-(((z - z0) / reach) ** 2))
    inv = torch.where(z > 0, 1 / z.clamp_min(1e-6), torch.zeros_like(z))
    A = torch.stack([dx.float(), dy.float(), torch.ones(len(dx))], 1)  # [P, 3]
    M = (w @ (A[:, :, None] * A[:, None]).reshape(-1, 9)).reshape(-1, 3, 3) + 1e-4 * torch.eye(3)
    b = (w * inv) @ A
    g = torch.linalg.solve(M, b)  # 1/z = g0 dx + g1 dy + g2
    K = stack.K[view]
    fx, fy, cx, cy = K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]
    u, v = x + 0.5, y + 0.5
    # n . X = 1 with 1/z = n . ((u-cx)/fx, (v-cy)/fy, 1)
    n = torch.stack([g[:, 0] * fx, g[:, 1] * fy, g[:, 2] - g[:, 0] * (u - cx) - g[:, 1] * (v - cy)], 1)
    ray = torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u)], 1)
    zc = 1 / g[:, 2].clamp_min(1e-6)
    n = -n / n.norm(dim=1, keepdim=True).clamp_min(1e-9)
    R, t = stack.viewmat[view, :3, :3], stack.viewmat[view, :3, 3]
    point = torch.einsum("mij,mi->mj", R, ray * zc[:, None] - t)
    cosine = -(n * ray).sum(1) / ray.norm(dim=1)
    return point, torch.einsum("mij,mi->mj", R, n), w.sum(1), cosine


def view_planes(stack: DepthStack, reach: float, stride: int = 2) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What the depth maps say of surfaces: points [M, 3], normals [M, 3], the view [M] that saw them and how well [M]
    it did."""
    v, y, x = torch.nonzero(stack.valid[:, ::stride, ::stride], as_tuple=True)
    point, normal, support, cosine = window_planes(stack, v, y * stride, x * stride, reach)
    keep = (support > 7) & (cosine > 0.2)
    return point[keep], normal[keep], v[keep], (support * cosine)[keep]


def fuse(planes: tuple[Tensor, Tensor, Tensor, Tensor], cell: float) -> tuple[Tensor, Tensor, Tensor]:
    """Average ``view_planes`` in cells of space and facing -> points, normals, number of views that saw the cell."""
    point, normal, v, weight = planes
    V = int(v.max()) + 1 if len(v) else 1
    side = normal.abs().argmax(1)
    side = side * 2 + (normal.gather(1, side[:, None])[:, 0] > 0)
    lo = point.min(0).values
    code = ((point - lo) / cell).long()
    size = code.max(0).values + 1
    code = ((code[:, 0] * size[1] + code[:, 1]) * size[2] + code[:, 2]) * 6 + side
    code, inverse = torch.unique(code, return_inverse=True)
    n = len(code)
    total = torch.zeros(n).index_add_(0, inverse, weight)
    points = torch.zeros(n, 3).index_add_(0, inverse, point * weight[:, None]) / total[:, None]
    normals = torch.zeros(n, 3).index_add_(0, inverse, normal * weight[:, None])
    seen = torch.unique(inverse * V + v) // V
    views = torch.zeros(n).index_add_(0, seen, torch.ones(len(seen)))
    return points, torch.nn.functional.normalize(normals, dim=1), views


def measure_noise(stack: DepthStack, points: Tensor, normals: Tensor, limit: float, views: Tensor) -> float:
    """1.48 x median |distance along the normal| between surfels and the depth maps that face them, within ``limit``."""
    z, index, inside = stack.project(points, views)
    ray = torch.nn.functional.normalize(points[:, None] - stack.position[views], dim=2)
    cosine = -(ray * normals[:, None]).sum(2)
    r = (stack.depth.reshape(-1)[index] - z) * cosine
    ok = inside & stack.valid.reshape(-1)[index] & (cosine > 0.4) & (r.abs() < limit)
    return float(MEDIAN_SIGMA * r[ok].abs().median()) if ok.any() else limit / 3


def build_surfels(
    evidence: StateEvidence, stack: DepthStack, diag: float, target: int, floor: float
) -> tuple[Surfels, dict]:
    """Surfels of one state (at most about ``target``) and the figures of each step. diag: box diagonal; floor: least
    noise / diag."""
    cell, reach = 0.006 * diag, 0.02 * diag
    stride = 1 if int(stack.valid.sum()) < 12 * target else 2
    planes = view_planes(stack, reach, stride)
    for _ in range(4):
        points, normals, views = fuse(planes, cell)
        if len(points) < 1.3 * target:
            break
        cell *= (len(points) / target) ** 0.5
    raw = len(points)
    keep = views >= min(3, max(1, len(stack) // 8))
    points, normals = points[keep], normals[keep]
    some = stack.spread(24)
    noise = max(measure_noise(stack, points, normals, 0.04 * diag, some), floor * diag)
    tau = 3 * noise + 0.2 * cell
    free, on, _ = stack.counts(points, tau)
    keep = ~((free >= 4) & (free > 1.5 * on))
    points, normals = points[keep], normals[keep]
    d, _ = cKDTree(points.numpy()).query(points.numpy(), k=9)
    keep = torch.from_numpy(d[:, 1:].mean(1) < 3 * np.median(d[:, 1:].mean(1)))
    points, normals = points[keep], normals[keep]
    points, normals = settle(points, normals, radius=2.5 * cell)
    d, _ = cKDTree(points.numpy()).query(points.numpy(), k=5)
    tree = cKDTree(evidence.points.numpy())
    _, near = tree.query(points.numpy(), k=min(4, len(evidence.points)))
    colours = evidence.colours[torch.from_numpy(np.asarray(near).reshape(len(points), -1))].mean(1)
    noise = max(measure_noise(stack, points, normals, 0.04 * diag, some), floor * diag)
    figures = {
        "surfels_raw": raw,
        "surfels": len(points),
        "cell": cell,
        "noise": noise,
        "spacing": float(np.median(d[:, 4])),
    }
    return Surfels(points, normals, colours.float(), float(np.median(d[:, 4])), noise), figures


def settle(points: Tensor, normals: Tensor, radius: float, k: int = 16, rounds: int = 2) -> tuple[Tensor, Tensor]:
    """Smooth: average normals over neighbours that agree in side and plane, then move points 80 % of the way onto the
    local plane."""
    _, idx = cKDTree(points.numpy()).query(points.numpy(), k=min(k, len(points)))
    idx = torch.from_numpy(idx)
    d = points[idx] - points[:, None]
    near = torch.exp(-((d.norm(dim=2) / radius) ** 2))
    for _ in range(rounds):
        agree = (normals[idx] * normals[:, None]).sum(2).clamp_min(0) ** 4
        off = (d * normals[:, None]).sum(2)
        w = near * agree * torch.exp(-((off / (0.4 * radius)) ** 2))
        normals = torch.nn.functional.normalize((w[..., None] * normals[idx]).sum(1), dim=1)
    off = (d * normals[:, None]).sum(2)
    w = near * (normals[idx] * normals[:, None]).sum(2).clamp_min(0) ** 4 * torch.exp(-((off / (0.4 * radius)) ** 2))
    return points + 0.8 * normals * ((w * off).sum(1) / w.sum(1).clamp_min(1e-6))[:, None], normals
