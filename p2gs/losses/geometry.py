"""Losses on geometry: ``depth``, ``surface_depth``, ``depth_variance`` and ``planar`` on rendered depth, ``flat`` on
the Gaussians themselves."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.losses.base import Loss, LossInputs, register_loss
from p2gs.ops.pixels import depth_range, depth_spread
from p2gs.ops.planar import hidden_bends
from p2gs.ops.planes import plane_error
from p2gs.ops.rays import camera_rays
from p2gs.types import RenderOutput, UserError


@register_loss("depth")
class Depth(Loss):
    """mean log(1 + |d - d*|) over the pixels whose depth is known (ArtGS's form). Not in the paper; None without depth
    maps.

    d is the mean depth of the middles of what the ray hits, in internal units (the object's diagonal is 2). Left out
    are pixels that the render covers by less than ``min_alpha``, whose mean depth means little and has a large
    gradient, and those next to which depth jumps by more than ``edge`` (None: none): the photograph's pixel shows both
    surfaces, the map one.
    """

    needs = frozenset()
    kind = "image"
    weight: float = 0.5
    min_alpha: float = 0.1
    edge: float | None = None

    def compute(self, inputs: LossInputs) -> Tensor | None:
        found = _known_depth(inputs, self.min_alpha, self.edge)
        if found is None:
            return None
        render, known, counted = found
        error = torch.where(counted, (render.expected_depth - known).abs(), torch.zeros_like(known))
        return error.log1p().sum() / counted.sum().clamp_min(1)


@register_loss("surface_depth")
class SurfaceDepth(Loss):
    """``depth`` of the surface: where rays meet the Gaussians' planes (``ops.planes.plane_error``), of which meshes are
    made, too. Not in the paper; None without depth maps.

    Held by their middles, which lean towards the camera where rays graze, Gaussians end behind the true surface.
    """

    needs = frozenset({"planes"})
    kind = "image"
    weight: float = 10.0
    min_alpha: float = 0.1
    edge: float | None = 0.1

    def compute(self, inputs: LossInputs) -> Tensor | None:
        found = _known_depth(inputs, self.min_alpha, self.edge)
        if found is None or found[0].features is None or inputs.camera is None:
            return None
        render, known, counted = found
        return plane_error(render.painted, camera_rays(inputs.camera).to(known.device), known, counted)


def _known_depth(
    inputs: LossInputs, min_alpha: float, edge: float | None
) -> tuple[RenderOutput, Tensor, Tensor] | None:
    """The render, the target's depth map [H, W] and the pixels [H, W] bool at which it counts (``Depth``); None without
    a map."""
    render, target = inputs.render, inputs.target
    if render is None or target is None or target.depth is None:
        return None
    counted = (target.depth > 0) & (render.alpha.detach() > min_alpha)
    return render, target.depth, counted if edge is None else counted & (_jumps(inputs) <= edge)


def _jumps(inputs: LossInputs) -> Tensor:
    """``depth_range`` of the target's depth map, of which every view has one at a time: found once."""
    target = inputs.target
    assert target is not None and target.depth is not None
    if target.view is None:
        return depth_range(target.depth)
    key = ("depth_range", target.view)
    if key not in inputs.cache:
        inputs.cache[key] = depth_range(target.depth)
    return inputs.cache[key]


@register_loss("depth_variance")
class DepthVariance(Loss):
    """2 x mean over the foreground of alpha^2 times the variance of depth along the ray. Not in the paper.

    Gathers what a ray sees at one depth: pictures alone leave textureless surfaces a fog that photometric error cannot
    see. The foreground is where the photograph's alpha is above one half. The default weight falls from 30 to 10 over
    its span, in the units of an object of unit size. None where the render carries no squared depth
    (``RenderOutput.depth_sq``).

    knee: spread (a standard deviation, internal units) from which on a ray counts ever less
    (``ops.pixels.depth_spread``; None: all count alike). What it meets then is no fog but two surfaces, as at an
    opening, and which of them is there the photographs are to say: alike, the front wins.
    """

    needs = frozenset({"depth_sq"})
    kind = "prior"
    weight: float = 30.0
    end_weight: float | None = 10.0
    knee: float | None = None

    def __post_init__(self):
        if self.knee is not None and not self.knee > 0:
            raise UserError(f"losses.depth_variance.knee: expected a length above 0 or null, got {self.knee}")

    def compute(self, inputs: LossInputs) -> Tensor | None:
        render, target = inputs.render, inputs.target
        if render is None or target is None or render.depth_sq is None:
            return None
        return 2 * depth_spread(render.alpha, render.depth, render.depth_sq, target.alpha, render.depth_ref, self.knee)


@register_loss("planar")
class Planar(Loss):
    """Where a photograph shows nothing between two pixels, the surface between them is flat. Not in the paper.

    Second differences of inverse depth (zero on a plane, in every perspective) over segments of 2 x ``strides`` pixels
    along rows and columns, in units of depth, each weighted by exp(-t / contrast), t the photograph's total variation
    along the segment less ``noise`` a pixel. Segments that leave the foreground do not count. Photometric error cannot
    see dents in plain walls; their rims it can, and this carries the rim's depth inwards.
    """

    needs = frozenset()
    kind = "prior"
    weight: float = 0.1
    strides: tuple[int, ...] = (3, 9, 27)
    contrast: float = 0.1
    noise: float = 0.01

    def compute(self, inputs: LossInputs) -> Tensor | None:
        render, target = inputs.render, inputs.target
        if render is None or target is None:
            return None
        return hidden_bends(
            target.image, target.alpha, render.depth, render.alpha, self.strides, self.contrast, self.noise
        )


@register_loss("flat")
class Flat(Loss):
    """Mean over Gaussians of their shortest standard deviation (Chen et al. 2024, PGSR, arXiv:2406.06521). Not in the
    paper.

    Seen edge-on a surface is a stack of Gaussians as thick as they are: their faint rims add up, the outline grows by
    two or three standard deviations, and training puts that right by pulling the surface inward. Flat ones have no
    rims.
    """

    needs = frozenset()
    kind = "prior"
    weight: float = 1.0

    def compute(self, inputs: LossInputs) -> Tensor:
        return inputs.gaussians.log_scales.min(dim=1).values.exp().mean()
