"""Shapes, units and conventions, stated once.

Cameras are OpenCV (x right, y down, z forward). ``viewmat`` maps world to camera, ``K`` maps camera to pixels with
pixel centres at +0.5. Quaternions are wxyz. State time ``t`` runs from 0 (start) to 1 (end). Alpha is straight on disk
and in ``View``; compositing is done in float. Units are the input's unless a ``Similarity`` says otherwise.
"""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, field, replace
from typing import Literal, Optional

import torch
from torch import Tensor

Split = Literal["train", "val", "test"]
JointType = Literal["revolute", "prismatic"]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    viewmat: [4, 4] float32, world -> camera.  K: [3, 3] float32 in pixels.  width, height: pixels.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    @property
    def position(self) -> Tensor:
        """Camera centre in world coordinates, [3]."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def to(self, device) -> "Camera":
        """The same camera with its matrices on ``device``."""
        return Camera(self.viewmat.to(device), self.K.to(device), self.width, self.height)

    def scaled(self, width: int, height: int) -> "Camera":
        """The same camera with an image of another size (pixel centres stay at +0.5)."""
        K = self.K.clone()
        K[0] *= width / self.width
        K[1] *= height / self.height
        return Camera(self.viewmat, K, width, height)

    def cropped(self, x: int, y: int, width: int, height: int) -> "Camera":
        """The camera of the window [y:y+height, x:x+width] of this image."""
        K = self.K.clone()
        K[0, 2] -= x
        K[1, 2] -= y
        return Camera(self.viewmat, K, width, height)


@dataclass(frozen=True)
class View:
    """One photograph.

    image: [H, W, 3] uint8, straight (not premultiplied).  alpha: [H, W] uint8.  depth: [H, W] float32 along the
    camera's z in scene units, 0 where unknown, or None.
    """

    name: str
    state: int
    split: Split
    camera: Camera
    image: Tensor
    alpha: Tensor
    depth: Optional[Tensor] = None


@dataclass(frozen=True)
class Similarity:
    """x_internal = scale * (x_input - center). Training runs in internal units; every export goes back."""

    scale: float = 1.0
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def to_internal(self, points: Tensor) -> Tensor:
        return (points - points.new_tensor(self.center)) * self.scale

    def to_input(self, points: Tensor) -> Tensor:
        return points / self.scale + points.new_tensor(self.center)

    def transform_to_input(self, T: Tensor) -> Tensor:
        """A rigid motion [4, 4] given in internal coordinates, in input coordinates."""
        R, t, c = T[:3, :3], T[:3, 3], T.new_tensor(self.center)
        out = T.clone()
        out[:3, 3] = t / self.scale + c - R @ c
        return out


@dataclass(frozen=True)
class TwoStateScene:
    """The photographs of one object in two joint states. Never holds ground truth.

    ``similarity`` tells how the views' coordinates relate to the input's (identity as read from disk).
    ``box``: [2, 3] float32, lower and upper corner of the object, found from masks (internal units), or None.
    """

    name: str
    views: tuple[View, ...]
    similarity: Similarity = field(default_factory=Similarity)
    box: Optional[Tensor] = None

    def select(self, state: Optional[int] = None, split: Optional[Split] = None) -> tuple[View, ...]:
        return tuple(
            v for v in self.views if (state is None or v.state == state) and (split is None or v.split == split)
        )

    @property
    def has_depth(self) -> bool:
        """Whether every training view has a depth map."""
        train = self.select(split="train")
        return bool(train) and all(v.depth is not None for v in train)

    def with_views(self, views) -> "TwoStateScene":
        return replace(self, views=tuple(views))


@dataclass
class GaussianTensors:
    """Stored, unconstrained parameters of N Gaussians.

    means [N, 3]; quats [N, 4] wxyz, any length; log_scales [N, 3]; opacity_logits [N]; sh [N, B, 3] with B =
    (degree+1)^2, colour = 0.5 + SH (the 3DGS convention).
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor

    NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
    SOLID = 0.5  # opacity above which a Gaussian is surface

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def solid(self) -> Tensor:
        """[N] bool: which are surface, more opaque than ``SOLID``."""
        return torch.sigmoid(self.opacity_logits) > self.SOLID

    def placed(self, means: Tensor, quats: Tensor) -> "GaussianTensors":
        """The same Gaussians elsewhere: other centres [N, 3] and orientations [N, 4]."""
        return GaussianTensors(means, quats, self.log_scales, self.opacity_logits, self.sh)

    def __getitem__(self, index) -> "GaussianTensors":
        return GaussianTensors(*(getattr(self, n)[index] for n in self.NAMES))

    def detach(self) -> "GaussianTensors":
        return GaussianTensors(*(getattr(self, n).detach() for n in self.NAMES))

    def clone(self) -> "GaussianTensors":
        return GaussianTensors(*(getattr(self, n).detach().clone() for n in self.NAMES))

    def to(self, device) -> "GaussianTensors":
        return GaussianTensors(*(getattr(self, n).to(device) for n in self.NAMES))

    @staticmethod
    def cat(items: list["GaussianTensors"]) -> "GaussianTensors":
        return GaussianTensors(*(torch.cat([getattr(g, n) for g in items]) for n in GaussianTensors.NAMES))


@dataclass
class RenderOutput:
    """What a rasterizer returns for one view of H x W pixels (accumulated = weighted sum over Gaussians, not
    normalised).

    colour [H, W, 3], background already blended in.  alpha [H, W].  depth [H, W]: accumulated z.  depth_sq [H, W] or
    None: accumulated (z - depth_ref)^2.  median_depth [H, W] or None: z of the Gaussian where transmittance passes 0.5,
    0 where it never does (no gradient).  features [H, W, F] or None, accumulated.
    radii [N] int32: screen radius in pixels, 0 where culled.  means2d_abs_grad [N] or None: see ``render.rasterize``.
    """

    colour: Tensor
    alpha: Tensor
    depth: Tensor
    depth_sq: Optional[Tensor] = None
    depth_ref: float = 0.0
    median_depth: Optional[Tensor] = None
    features: Optional[Tensor] = None
    radii: Optional[Tensor] = None
    means2d_abs_grad: Optional[Tensor] = None

    @property
    def painted(self) -> Tensor:
        """``features``, of a view that was asked for them. Raises ValueError for another."""
        if self.features is None:
            raise ValueError("this view was drawn without features")
        return self.features

    @property
    def expected_depth(self) -> Tensor:
        """Mean z over what the ray hits, [H, W]; 0 where nothing is hit."""
        return torch.where(self.alpha > 1e-6, self.depth / self.alpha.clamp_min(1e-6), torch.zeros_like(self.depth))

    @property
    def depth_variance(self) -> Tensor:
        """alpha * accumulated (z-ref)^2 - (accumulated (z-ref))^2, [H, W]: alpha^2 times the variance of z along the
        ray."""
        if self.depth_sq is None:
            raise ValueError("depth_variance needs rasterize(..., depth_sq=True)")
        first = self.depth - self.depth_ref * self.alpha
        return self.alpha * self.depth_sq - first * first


@dataclass(frozen=True)
class Joint:
    """A one-degree-of-freedom joint. axis [3] unit, origin [3] a point on the axis (prismatic: a point of the part).

    motion: signed start -> end, degrees about the axis or length along it.  limits: (lo, hi) in the same unit, 0 =
    start.
    transform: [4, 4] start -> end.
    """

    type: JointType
    axis: Tensor
    origin: Tensor
    motion: float
    limits: tuple[float, float]
    transform: Tensor


@dataclass(frozen=True)
class Part:
    """A part of the twin. ``joint`` is None for the static base (id 0).  alternatives: other joints that explain the
    photographs as well."""

    id: int
    joint: Optional[Joint] = None
    gaussians: int = 0
    confidence: float = 1.0
    alternatives: tuple[Joint, ...] = ()


@dataclass
class ArticulatedObject:
    """The twin: Gaussians at canonical time, a part id each, a joint per movable part.

    part_ids [N] int64 into ``parts``.  A point of part k goes from canonical time t_c to state t by
    exp((t - t_c) * log(T_k)), T_k the joint's start -> end transform. Coordinates are internal; ``similarity`` goes
    back.
    """

    gaussians: GaussianTensors
    part_ids: Tensor
    parts: list[Part]
    canonical_time: float
    similarity: Similarity = field(default_factory=Similarity)


def short(value: object, length: int = 80) -> str:
    """``repr`` of what a file holds, for a message: one line of at most about so many characters, however large or deep
    the value."""
    if isinstance(value, str):
        text = repr(value[:length])
    elif isinstance(value, int) and value.bit_length() > 200:  # str() of a longer number is refused, or slow
        text = "a whole number of many digits"
    else:
        text = _REPR.repr(value)
    return text if len(text) <= length + 2 else f"{text[:length]}..."


_REPR = reprlib.Repr()


class UserError(Exception):
    """A mistake of the user's, told in one sentence (which file, what is wrong, what was expected); printed without a
    traceback."""
