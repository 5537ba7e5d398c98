"""The planes in which Gaussians lie, and where rays meet them: there a surface is, not where their middles are.

A ray that grazes a surface of large flat Gaussians meets, in front, tails of Gaussians whose middles are nearer than
the surface is there. Depth composited from middles is off by as much as the Gaussians are large, differently in every
view: a surface made of it is torn, and Gaussians of which it is held against a depth map lie behind the true surface.
"""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.ops import so3
from p2gs.types import Camera

LEAST_COSINE = 0.05  # between a ray and the mean normal along it: seen more edge-on, a plane tells no depth


def planes(means: Tensor, quats: Tensor, log_scales: Tensor, eye: Tensor) -> tuple[Tensor, Tensor]:
    """The planes through the middles [N, 3] in which Gaussians are densest along rays from ``eye`` [3] past them: unit
    normals [N, 3] that face away from it, and distances from it [N].

    To first order that is the plane across inverse(covariance) (mean - eye): the flat side of a flat Gaussian, and
    across the ray for a round one (RaDe-GS, arXiv:2406.01467).
    """
    R = so3.quat_to_matrix(so3.quat_normalize(quats))
    along = (R * (means - eye)[:, :, None]).sum(1)  # in the Gaussian's own frame
    sharpest = log_scales.amin(1, keepdim=True)  # any common factor will do
    normal = torch.nn.functional.normalize(along * torch.exp(2 * (sharpest - log_scales)), dim=1)
    return (R * normal[:, None]).sum(2), (normal * along).sum(1)


def plane_features(means: Tensor, quats: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    """What ``plane_depth`` wants composited of Gaussians, [N, 4]: ``planes`` seen by the camera, as normal, in its
    coordinates, and distance. Differentiable by means, quats and log_scales."""
    given = (means, quats, log_scales)
    if native is None or any(t.dtype != torch.float32 or t.is_cuda for t in given):
        return plane_features_reference(*given, camera)
    return _PlaneFeatures.apply(*given, camera.position.tolist(), camera.viewmat[:3, :3].flatten().tolist())


def plane_features_reference(means: Tensor, quats: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    """``plane_features`` in torch, in the dtype of ``means``."""
    normal, distance = planes(means, quats, log_scales, camera.position.to(means))
    return torch.cat([normal @ camera.viewmat[:3, :3].T.to(means), distance[:, None]], 1)


class _PlaneFeatures(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, log_scales, eye, rotation):
        given = [t.contiguous() for t in (means, quats, log_scales)]
        ctx.save_for_backward(*given)
        ctx.seen_by = ([t.data_ptr() for t in given], eye, rotation, len(means))
        out = torch.empty(len(means), 4)
        native.plane_features(*ctx.seen_by, out.data_ptr(), num_threads())
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output):
        grad_output, out = grad_output.contiguous(), [torch.empty_like(t) for t in ctx.saved_tensors]
        native.plane_gradients(*ctx.seen_by, grad_output.data_ptr(), [t.data_ptr() for t in out], num_threads())
        return *out, None, None


def plane_depth(features: Tensor, rays: Tensor) -> Tensor:
    """Depth along z [H, W] at which pixels meet the mean of their Gaussians' planes (PGSR, arXiv:2406.06521); 0 where
    nothing is hit or the plane is seen edge-on.

    features [H, W, 4]: accumulated ``plane_features``.  rays [H, W, 3]: of unit z through the pixels' centres.
    """
    normal, distance = features[..., :3], features[..., 3]
    slope = (normal * rays).sum(-1)
    met = slope.detach() > LEAST_COSINE * normal.detach().norm(dim=-1) * rays.norm(dim=-1)
    return torch.where(met, distance / torch.where(met, slope, torch.ones_like(slope)), torch.zeros_like(slope))


def plane_error(features: Tensor, rays: Tensor, depth: Tensor, counted: Tensor) -> Tensor:
    """Mean of log(1 + |d - depth|) over the pixels ``counted`` [H, W] bool that meet a plane, d their ``plane_depth``:
    a scalar, 0 where there are none, differentiable by features.

    features [H, W, 4] and rays [H, W, 3]: as there.  depth [H, W]: what is known.
    """
    if native is None or any(t.dtype != torch.float32 or t.is_cuda for t in (features, rays, depth)):
        return plane_error_reference(features, rays, depth, counted)
    return _PlaneError.apply(features, rays.contiguous(), depth.contiguous(), counted.contiguous())


def plane_error_reference(features: Tensor, rays: Tensor, depth: Tensor, counted: Tensor) -> Tensor:
    """``plane_error`` in torch."""
    found = plane_depth(features, rays)
    counted = counted & (found.detach() != 0)
    error = torch.where(counted, (found - depth).abs(), torch.zeros_like(depth))
    return error.log1p().sum() / counted.sum().clamp_min(1)


class _PlaneError(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, rays, depth, counted):
        given = [features.contiguous(), rays, depth, counted]
        ctx.save_for_backward(*given)
        error, pixels = native.plane_error(
            [*(t.data_ptr() for t in given), 0], depth.numel(), LEAST_COSINE, 1.0, num_threads()
        )
        ctx.pixels = max(pixels, 1)
        return features.new_tensor(error / ctx.pixels)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output):
        given = ctx.saved_tensors
        out = torch.empty_like(given[0])
        scale = grad_output.item() / ctx.pixels
        native.plane_error([t.data_ptr() for t in (*given, out)], given[2].numel(), LEAST_COSINE, scale, num_threads())
        return out, None, None, None
