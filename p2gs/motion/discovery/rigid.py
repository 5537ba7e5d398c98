"""Batches of one-degree-of-freedom motions: slides and turns, by direction, centre and amount."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.native import native


def rotation(axis: Tensor, angle: Tensor) -> Tensor:
    """Rodrigues: axis [..., 3] unit, angle [...] rad -> [..., 3, 3]."""
    x, y, z = axis.unbind(-1)
    o = torch.zeros_like(x)
    K = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*axis.shape[:-1], 3, 3)
    s, c = torch.sin(angle)[..., None, None], torch.cos(angle)[..., None, None]
    return torch.eye(3, dtype=axis.dtype) + s * K + (1 - c) * K @ K


def perpendicular(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors [..., 3] that complete ``axis`` [..., 3] to a right-handed frame."""
    helper = torch.zeros_like(axis).scatter_(-1, axis.abs().argmin(-1, keepdim=True), 1.0)
    e1 = torch.nn.functional.normalize(torch.linalg.cross(helper, axis), dim=-1)
    return e1, torch.linalg.cross(axis, e1)


ONE_WAY = 1 - 1e-6  # cosine of what rounding does to one direction: slides that were fitted one by one differ by more


def same_place(places: Tensor, at: Tensor, within: float) -> Tensor:
    """[P, K] bool: which of ``places`` [K, P, 3] of each point lie within ``within`` of ``at`` [P, 3]."""
    return ((places - at).norm(dim=2) < within).T


@dataclass
class Motions:
    """B motions start -> end. turn [B] bool (revolute); axis [B, 3] unit; centre [B, 3] a point on the axis (unused by
    slides); amount [B]: radians or scene units, signed along the axis.  thick [B]: thickness (scene units) of the plate
    that moves, of which one state may show one side and the other state the other; 0 (the default): sides are told
    apart by nothing but themselves."""

    turn: Tensor
    axis: Tensor
    centre: Tensor
    amount: Tensor
    thick: Tensor = None  # pyright: ignore[reportAssignmentType]  (zeros, once it is made)

    def __post_init__(self) -> None:
        if self.thick is None:
            self.thick = torch.zeros(len(self.amount))

    def __len__(self) -> int:
        return len(self.amount)

    def __getitem__(self, index) -> "Motions":
        return Motions(self.turn[index], self.axis[index], self.centre[index], self.amount[index], self.thick[index])

    @staticmethod
    def cat(items: list["Motions"]) -> "Motions":
        return Motions(
            *(torch.cat([getattr(m, n) for m in items]) for n in ("turn", "axis", "centre", "amount", "thick"))
        )

    @staticmethod
    def empty() -> "Motions":
        return Motions(torch.zeros(0, dtype=torch.bool), torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))

    def packed(self) -> list[Tensor]:
        """turn, axis, centre, amount as the kernels take them, contiguous; the caller keeps them while their addresses
        are in use."""
        parts = [self.turn, self.axis, self.centre, self.amount]
        return [x.contiguous() if x.dtype in (torch.float32, torch.bool) else x.float().contiguous() for x in parts]

    def matrices(self) -> tuple[Tensor, Tensor]:
        """R [B, 3, 3], t [B, 3]."""
        if native is None or self.amount.dtype != torch.float32:
            return self.matrices_reference()
        moving, R, t = self.packed(), torch.empty(len(self), 3, 3), torch.empty(len(self), 3)
        native.motion_matrices([m.data_ptr() for m in moving], len(self), R.data_ptr(), t.data_ptr())
        return R, t

    def matrices_reference(self) -> tuple[Tensor, Tensor]:
        """``matrices`` in torch, in the motions' own dtype."""
        R = rotation(self.axis, torch.where(self.turn, self.amount, torch.zeros_like(self.amount)))
        t = torch.where(
            self.turn[:, None],
            self.centre - torch.einsum("bij,bj->bi", R, self.centre),
            self.axis * self.amount[:, None],
        )
        return R, t

    def transform(self, i: int) -> Tensor:
        """[4, 4] float64 of motion ``i``."""
        one = Motions(*(getattr(self, n)[i : i + 1] for n in ("turn", "axis", "centre", "amount")))
        one.axis, one.centre, one.amount = one.axis.double(), one.centre.double(), one.amount.double()
        one.axis = one.axis / one.axis.norm()
        R, t = one.matrices()
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3], T[:3, 3] = R[0], t[0]
        return T

    def apply(self, points: Tensor, inverse: bool = False) -> Tensor:
        """points [P, 3] or [B, P, 3] -> [B, P, 3], moved by T or, ``inverse``, by T^-1."""
        R, t = self.matrices()
        p = points.expand(len(self), *points.shape[-2:])
        return (p - t[:, None]) @ R if inverse else p @ R.transpose(1, 2) + t[:, None]

    def places(self, points: Tensor, inverse: bool = False) -> Tensor:
        """points [P, 3] -> [B + 1, P, 3]: where they are, and where each motion takes them."""
        return torch.cat([points[None], self.apply(points, inverse)])

    def rotate(self, normals: Tensor, inverse: bool = False) -> Tensor:
        """Directions [P, 3] or [B, P, 3] -> [B, P, 3]."""
        R = self.matrices()[0]
        n = normals.expand(len(self), *normals.shape[-2:])
        return n @ R if inverse else n @ R.transpose(1, 2)

    def displaced(self, step: Tensor) -> "Motions":
        """Add a step [B, 5] in each motion's own coordinates.

        Turns: angle (rad), tilt about e1, e2 (rad, about the centre), centre along e1, e2.  Slides: amount, sideways
        e1, e2, -, -. Zero pitch and zero rotation hold by construction.
        """
        if native is None or self.amount.dtype != torch.float32:
            return self.displaced_reference(step)
        moving, step = self.packed(), step.float().contiguous()
        out = Motions(
            self.turn, torch.empty(len(self), 3), torch.empty(len(self), 3), torch.empty(len(self)), self.thick
        )
        native.motion_displaced(
            [m.data_ptr() for m in moving],
            len(self),
            step.data_ptr(),
            out.axis.data_ptr(),
            out.centre.data_ptr(),
            out.amount.data_ptr(),
        )
        return out

    def displaced_reference(self, step: Tensor) -> "Motions":
        """``displaced`` in torch."""
        e1, e2 = perpendicular(self.axis)
        tilt = step[:, 1:2] * e1 + step[:, 2:3] * e2
        angle = tilt.norm(dim=1)
        R = rotation(tilt / angle.clamp_min(1e-12)[:, None], angle)
        axis_turn = torch.nn.functional.normalize(torch.einsum("bij,bj->bi", R, self.axis), dim=1)
        slide = self.axis * (self.amount + step[:, 0])[:, None] + tilt
        length = slide.norm(dim=1)
        sign = torch.where((slide * self.axis).sum(1) < 0, -1.0, 1.0)
        axis_slide = torch.where(
            length[:, None] > 1e-9, slide / length.clamp_min(1e-9)[:, None] * sign[:, None], self.axis
        )
        turn = self.turn[:, None]
        return Motions(
            self.turn,
            torch.where(turn, axis_turn, axis_slide),
            torch.where(turn, self.centre + step[:, 3:4] * e1 + step[:, 4:5] * e2, self.centre),
            torch.where(self.turn, self.amount + step[:, 0], length * sign),
            self.thick,
        )

    def twist_basis(self) -> Tensor:
        """[B, 6, 5]: left twist (omega, v) of T, x -> x + omega x x + v, per unit of each coordinate of
        ``displaced``."""
        R, t = self.matrices()
        e1, e2 = perpendicular(self.axis)
        zero = torch.zeros_like(e1)
        cross = torch.linalg.cross

        def conjugated(omega: Tensor, v: Tensor) -> Tensor:  # (I - Ad_T) (omega, v)
            w = torch.einsum("bij,bj->bi", R, omega)
            u = torch.einsum("bij,bj->bi", R, v) + cross(t, w)
            return torch.cat([omega - w, v - u], 1)

        turn = torch.stack(
            [
                torch.cat([self.axis, cross(self.centre, self.axis)], 1),
                conjugated(e1, cross(self.centre, e1)),
                conjugated(e2, cross(self.centre, e2)),
                conjugated(zero, e1),
                conjugated(zero, e2),
            ],
            2,
        )
        slide = torch.stack([torch.cat([zero, v], 1) for v in (self.axis, e1, e2, zero, zero)], 2)
        return torch.where(self.turn[:, None, None], turn, slide)

    def swept(self, points: Tensor, other: "Motions") -> Tensor:
        """Root mean square distance between the images of points [P, 3] under every motion here and every other: [B,
        C]."""
        if (
            native is None
            or not len(points)
            or not points.dtype == self.amount.dtype == other.amount.dtype == torch.float32
        ):
            return self.swept_reference(points, other)
        a, b, points, out = self.packed(), other.packed(), points.contiguous(), torch.empty(len(self), len(other))
        native.motion_swept(
            [m.data_ptr() for m in a],
            len(self),
            [m.data_ptr() for m in b],
            len(other),
            points.data_ptr(),
            len(points),
            out.data_ptr(),
        )
        return out

    def swept_reference(self, points: Tensor, other: "Motions") -> Tensor:
        """``swept`` in torch, point by point."""
        a, b = self.apply(points), other.apply(points)
        return (a[:, None] - b[None]).pow(2).sum(-1).mean(-1).sqrt()


def without(motions: Motions, k: int) -> Motions:
    """All motions but ``k``."""
    return motions[torch.tensor([i for i in range(len(motions)) if i != k], dtype=torch.long)]


def axes_used(motions: Motions) -> int:
    """How many axes the motions have: one for each turn, one for each direction that slides share (``ONE_WAY``)."""
    ways = motions.axis[:0]
    for way in motions.axis[~motions.turn]:
        if not bool(one_way(ways, way).any()):
            ways = torch.cat([ways, way[None]])
    return int(motions.turn.sum()) + len(ways)


def one_way(axes: Tensor, axis: Tensor) -> Tensor:
    """[K] bool: which of ``axes`` [K, 3] (NaN: none) are the very direction ``axis`` [3], in either sense."""
    return (axes @ axis).abs() > ONE_WAY
