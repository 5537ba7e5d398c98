"""Adam's steps on rigid motions of joints of given types: turns keep their pitch at zero, slides do not turn."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.native import native
from p2gs.ops import se3, so3
from p2gs.ops.decay import exponential

KINDS = ["free", "revolute", "prismatic"]  # as the kernel numbers them


def along_axes(kinds: list[str], axes: Tensor, step: Tensor) -> Tensor:
    """Tangent steps [K, 6] without what would tilt joints whose axes [K, 3] are held (NaN: free): of a turn the
    rotation about its axis and the shift across it stay, of a slide the shift along it."""
    held = ~axes.isnan().any(1, keepdim=True)
    d = axes.nan_to_num()
    rotation, shift = ((x * d).sum(1, keepdim=True) * d for x in (step[:, :3], step[:, 3:]))
    slides = torch.tensor([kind == "prismatic" for kind in kinds])[:, None]
    return torch.where(held, torch.cat([rotation, torch.where(slides, shift, step[:, 3:] - shift)], 1), step)


def allowed_step(kinds: list[str], T: Tensor, centre: Tensor, radius: Tensor, step: Tensor) -> Tensor:
    """Project tangent steps [K, 6] = (rotation * radius, translation) at ``centre`` [K, 3] onto the motions of the
    joints' types.

    T [K, 4, 4], radius [K].  Prismatic: no rotation. Revolute: the pitch (translation along the axis) must stay zero,
    one linear condition; a Newton correction removes what pitch there is. Free: as it is.
    """
    rotvec = so3.matrix_to_rotvec(T[:, :3, :3])
    angle = rotvec.norm(dim=1, keepdim=True).clamp_min(1e-3)
    axis, t = rotvec / angle, T[:, :3, 3]
    pitch = (axis * t).sum(1, keepdim=True)
    across = t - axis * pitch
    # the axis turns by the inverse left Jacobian of the rotation vector (Sola et al. 2018, arXiv:1812.01537, Eq. 146)
    tilt = across / (2 * torch.tan(angle / 2)) + torch.linalg.cross(axis, across) / 2
    normal = torch.cat([(torch.linalg.cross(t - centre, axis) + tilt) / radius[:, None], axis], 1)
    turned = step - normal * (
        ((normal * step).sum(1, keepdim=True) + pitch) / (normal * normal).sum(1, keepdim=True).clamp_min(1e-12)
    )
    slid = torch.cat([torch.zeros_like(step[:, :3]), step[:, 3:]], 1)
    by_type = {"revolute": turned, "prismatic": slid, "free": step}
    return torch.stack([by_type[kind][k] for k, kind in enumerate(kinds)]) if kinds else step


def apply_step(T: Tensor, centre: Tensor, radius: Tensor | float, step: Tensor) -> Tensor:
    """exp of the tangent step [..., 6] about ``centre`` [..., 3], after T [..., 4, 4]; radius [..., 1] or a number."""
    R = so3.rotvec_to_matrix(step[..., :3] / radius)
    return se3.make(R, centre - (R @ centre[..., None])[..., 0] + step[..., 3:]) @ T


class MotionSteps:
    """Adam (arXiv:1412.6980) on rigid part motions of given types.

    types: "revolute" | "prismatic" | "free" per part.  radius [K]: spread of each part's points.  rate: step size at
    the start in units of displacement at that radius; falls to a hundredth.  axes [K, 3]: directions that joints keep
    (NaN: free; None: all are).
    """

    def __init__(self, types: list[str], radius: Tensor, rate: float, axes: Tensor | None = None):
        self.types, self.radius, self.rate = types, radius.double().contiguous(), rate
        self.axes = None if axes is None else axes.double().contiguous()
        self.kinds = torch.tensor([KINDS.index(kind) for kind in types], dtype=torch.uint8)
        self.first, self.second = torch.zeros(len(types), 6).double(), torch.zeros(len(types), 6).double()
        self.taken = torch.zeros(len(types))

    def take(self, transforms: Tensor, gradient: Tensor, centre: Tensor, fraction: float, on: Tensor) -> Tensor:
        """The motions [K, 4, 4] after a step, all float64 on the CPU. gradient [K, 6]: by rotation about ``centre`` [K,
        3] and by translation.  fraction: how much of the descent is done.  on [K] bool: which parts have a say."""
        if native is None:
            return self.take_reference(transforms, gradient, centre, fraction, on)
        given = [x.contiguous() for x in (transforms, gradient, centre)]
        out, on = torch.empty_like(given[0]), on.contiguous()
        held, fades = 0 if self.axes is None else self.axes.data_ptr(), torch.stack(self._fades(on)).double()
        own = [x.data_ptr() for x in (fades, self.kinds, on, self.first, self.second)]
        addresses = [*(x.data_ptr() for x in given), self.radius.data_ptr(), held, *own]
        native.motion_steps(addresses, len(self.types), self.rate * exponential(1.0, 0.01, fraction), out.data_ptr())
        return out

    def take_reference(
        self, transforms: Tensor, gradient: Tensor, centre: Tensor, fraction: float, on: Tensor
    ) -> Tensor:
        """``take`` in torch."""
        radius = self.radius[:, None]
        gradient, on = torch.cat([gradient[:, :3] / radius, gradient[:, 3:]], 1), on[:, None]
        first, second = (fade[:, None] for fade in self._fades(on[:, 0]))
        self.first = torch.where(on, 0.9 * self.first + 0.1 * gradient, self.first)
        self.second = torch.where(on, 0.99 * self.second + 0.01 * gradient * gradient, self.second)
        direction = self.first / first / ((self.second / second).sqrt() + 1e-12)
        rate = self.rate * exponential(1.0, 0.01, fraction)
        delta = allowed_step(self.types, transforms, centre, self.radius, -rate * direction)
        delta = delta if self.axes is None else along_axes(self.types, self.axes, delta)
        transforms = torch.where(on[..., None], apply_step(transforms, centre, radius, delta), transforms)
        transforms[self.kinds == KINDS.index("prismatic"), :3, :3] = torch.eye(3, dtype=torch.float64)
        return transforms

    def _fades(self, on: Tensor) -> tuple[Tensor, Tensor]:
        """What the moments are divided by, as they started at 0, [K] each, once the parts that are ``on`` take one step
        more."""
        self.taken = self.taken + on
        seen = self.taken.clamp_min(1)
        return 1 - 0.9**seen, 1 - 0.99**seen

    def ended(self, transforms: Tensor) -> Tensor:
        """The motions without what pitch the last steps left to turns."""
        of_type = zip(self.types, transforms, strict=True)
        return torch.stack([se3.project_revolute(T) if kind == "revolute" else T for kind, T in of_type])
