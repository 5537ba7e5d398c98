"""What two reconstructed states say about space: seen through, surface, or hidden behind something.

A point of one state that the other state's cameras look *through* has moved. A point with something in *front* of it is
unknown, not moved: a cupboard's inside that appears when its door opens must not become a part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional, Sequence

import torch
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.ops.pixels import greatest_around
from p2gs.types import Camera


@dataclass
class StateEvidence:
    """One reconstructed state: a point cloud (the splat's centres) and rendered depth of its training views.

    points [N, 3]; colours [N, 3] in 0..1; normals [N, 3] or None; weights [N], e.g. opacity.
    depths: V maps [H, W] float32, z along the camera, 0 where nothing; alphas: V maps [H, W]; cameras: V cameras of
    that size.
    """

    points: Tensor
    colours: Tensor
    normals: Optional[Tensor]
    weights: Tensor
    depths: Sequence[Tensor]
    alphas: Sequence[Tensor]
    cameras: Sequence[Camera]


class DepthStack:
    """The depth maps of one state as intervals: near/far [V, H, W] are 3x3 minimum and maximum; background is
    infinitely far.

    The interval makes a depth edge count as surface, never as free space. Views of different size are padded to the
    largest. Raises ValueError where a map and its camera differ in size.
    """

    def __init__(self, depths: Sequence[Tensor], alphas: Sequence[Tensor], cameras: Sequence[Camera]):
        shapes = [(c.height, c.width) for c in cameras]
        if not len(depths) == len(alphas) == len(cameras) or any(
            tuple(d.shape) != size or tuple(a.shape) != size for d, a, size in zip(depths, alphas, shapes, strict=True)
        ):
            raise ValueError("every view needs a depth and an alpha map of its camera's size")
        H, W = max(h for h, _ in shapes), max(w for _, w in shapes)

        def stack(maps: Sequence[Tensor]) -> Tensor:
            return torch.stack(
                [torch.nn.functional.pad(m.float(), (0, W - m.shape[1], 0, H - m.shape[0])) for m in maps]
            )

        self.size = torch.tensor(shapes)  # [V, 2] height, width
        self.depth = stack(depths)
        self.valid = (stack(alphas) > 0.5) & (self.depth > 0)
        self.cameras = list(cameras)
        self.viewmat = torch.stack([c.viewmat for c in cameras]).float()
        self.K = torch.stack([c.K for c in cameras]).float()
        self.position = torch.stack([c.position for c in cameras]).float()
        R_t = self.viewmat[:, :3].reshape(-1, 12)
        K = self.K[:, [0, 1, 0, 1], [0, 1, 2, 2]]
        # [V, 18] as the kernel reads cameras
        self.rows = torch.cat([R_t, K, self.size.flip(1)], 1).float().contiguous()
        z = torch.where(self.valid, self.depth, torch.full_like(self.depth, torch.inf))
        self.far, self.near = greatest_around(z), -greatest_around(-z)

    def __len__(self) -> int:
        return len(self.cameras)

    def spread(self, n: int) -> Tensor:
        """Indices of at most ``n`` views, spread over the directions (farthest point order from view 0)."""
        if n >= len(self):
            return torch.arange(len(self))
        chosen = [0]
        d = (self.position - self.position[0]).norm(dim=1)
        while len(chosen) < n:
            chosen.append(int(d.argmax()))
            d = torch.minimum(d, (self.position - self.position[chosen[-1]]).norm(dim=1))
        return torch.tensor(sorted(chosen))

    def project(self, points: Tensor, views: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """points [N, 3] -> z [N, V], flat pixel index [N, V] (clamped) and whether it is inside the image [N, V]."""
        R, t, K = self.viewmat[views, :3, :3], self.viewmat[views, :3, 3], self.K[views]
        cam = torch.einsum("vij,nj->nvi", R, points) + t
        z = cam[..., 2]
        u = cam[..., 0] / z.clamp_min(1e-6) * K[:, 0, 0] + K[:, 0, 2]
        v = cam[..., 1] / z.clamp_min(1e-6) * K[:, 1, 1] + K[:, 1, 2]
        H, W = self.depth.shape[1:]
        height, width = self.size[views].unbind(1)
        inside = (z > 1e-6) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        index = v.clamp(0, H - 1).long() * W + u.clamp(0, W - 1).long()
        return z, index + views * (H * W), inside

    def counts(self, points: Tensor, tau: float, views: Optional[Tensor] = None) -> tuple[Tensor, Tensor, Tensor]:
        """How many views call each point free (they see past it), on a surface, behind one.  [N] float each.

        tau: tolerance along the ray, scene units. Views that do not contain the point say nothing.
        Raises IndexError for a view that does not exist.
        """
        views = torch.arange(len(self)) if views is None else views
        if native is None or points.dtype != torch.float32 or points.device.type != "cpu":
            return self.counts_reference(points, tau, views)
        if len(views) and not 0 <= int(views.min()) <= int(views.max()) < len(self):
            raise IndexError(f"views {views.tolist()} of {len(self)}")
        out = self._asked(native.depth_counts, points, tau, views)
        return out[0], out[1], out[2]

    def _asked(self, kernel, points: Tensor, tau: float, views: Tensor) -> Tensor:
        """What a kernel over depth maps makes of points [N, 3]: [3, N]."""
        views, points, out = views.contiguous(), points.contiguous(), torch.empty(3, len(points))
        kernel(
            self.near.data_ptr(),
            self.far.data_ptr(),
            self.rows.data_ptr(),
            *self.depth.shape[1:],
            views.data_ptr(),
            len(views),
            tau,
            points.data_ptr(),
            len(points),
            out.data_ptr(),
            num_threads(),
        )
        return out

    def counts_reference(
        self, points: Tensor, tau: float, views: Tensor, chunk: int = 1 << 20
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``counts`` in torch, ``chunk`` points times views at once."""
        out = points.new_zeros(3, len(points))
        step = max(1, chunk // max(1, len(views)))
        near, far = self.near.reshape(-1), self.far.reshape(-1)
        for i in range(0, len(points), step):
            z, index, inside = self.project(points[i : i + step], views)
            free = inside & (z < near[index] - tau)
            behind = inside & (z > far[index] + tau)
            out[0, i : i + step] = free.sum(1)
            out[1, i : i + step] = (inside & ~free & ~behind).sum(1)
            out[2, i : i + step] = behind.sum(1)
        return out[0], out[1], out[2]

    def seen_from(self, points: Tensor, tau: float) -> Tensor:
        """Mean direction [N, 3] (unit; 0 where no view sees it) from each point to the cameras that see it on a
        surface.

        tau: tolerance along the ray, scene units.
        """
        if native is None or points.dtype != torch.float32 or points.device.type != "cpu":
            return self.seen_from_reference(points, tau)
        sums = self._asked(native.depth_directions, points, tau, torch.arange(len(self)))
        return torch.nn.functional.normalize(sums.T.contiguous(), dim=1)

    def seen_from_reference(self, points: Tensor, tau: float) -> Tensor:
        """``seen_from`` in torch."""
        views = torch.arange(len(self))
        out = torch.zeros_like(points)
        step = max(1, (1 << 20) // len(self))
        near, far = self.near.reshape(-1), self.far.reshape(-1)
        for i in range(0, len(points), step):
            p = points[i : i + step]
            z, index, inside = self.project(p, views)
            on = inside & (z >= near[index] - tau) & (z <= far[index] + tau)
            way = torch.nn.functional.normalize(self.position - p[:, None], dim=2)
            out[i : i + step] = torch.where(on[..., None], way, torch.zeros_like(way)).sum(1)
        return torch.nn.functional.normalize(out, dim=1)

    def excess(self, points: Tensor, tau: float, limit: float = 8.0) -> Tensor:
        """Mean over the views that see past a point of how far they do, in units of tau, at most ``limit``; 0 where
        none does. [N]"""
        views = torch.arange(len(self))
        out = points.new_zeros(len(points))
        step = max(1, (1 << 20) // len(self))
        near = self.near.reshape(-1)
        for i in range(0, len(points), step):
            z, index, inside = self.project(points[i : i + step], views)
            past = (near[index] - z) / tau
            free = inside & (past > 1)
            out[i : i + step] = torch.where(free, past.clamp_max(limit), torch.zeros_like(past)).sum(1) / free.sum(
                1
            ).clamp_min(1)
        return out


def classify(free: Tensor, on: Tensor, need: float = 3.0, ratio: float = 1.5) -> tuple[Tensor, Tensor]:
    """Votes -> (moved, static): moved when at least ``need`` views see through and ``ratio`` times more than see a
    surface."""
    moved = (free >= need) & (free > ratio * on)
    static = (on >= 2) & (on > ratio * free)
    return moved, static
