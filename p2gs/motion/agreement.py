"""Which surface both states show: nothing else can tell where a part went.

A drawer's tray shows in one state alone, a flap its front in one and its back in the other, a dim inside is rebuilt
otherwise in either. Under the true motion such surface explains no photograph of the other state, and photographs would
pull the motion to where it covers more of it.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.gaussians.pose import with_static
from p2gs.motion.discovery.rigid import same_place
from p2gs.motion.light import seen_from
from p2gs.motion.screw_polish import MovedGaussians, PolishConfig
from p2gs.ops import se3, so3
from p2gs.ops.knn import knn
from p2gs.ops.sh import dc_to_rgb
from p2gs.types import Camera, GaussianTensors
from p2gs.visibility.depth_stack import DepthStack, classify
from p2gs.visibility.free_space import landed

EXTENT = 3.0  # standard deviations at which a Gaussian ends for the eye
# what ``unmoved`` found last: Gaussians, tolerance, result
_UNMOVED: WeakKeyDictionary[DepthStack, tuple] = WeakKeyDictionary()
# what ``next_to`` found last of what stays: Gaussians, the other state's, result
_NEAR: WeakKeyDictionary[DepthStack, tuple] = WeakKeyDictionary()
NEIGHBOURS = 4  # of the other state's Gaussians, one of which must be like the one that lands there


def kept_and_shown(
    states: list[StateGaussians],
    motions: PartMotions,
    state: int,
    lit: GaussianTensors,
    stacks: list[DepthStack],
    config: PolishConfig,
) -> tuple[Tensor, Tensor]:
    """Of the Gaussians of ``state``, [N] bool each: which nothing contradicts in the other state, and which the other
    state shows.

    Carried to the other state by its part's motion a Gaussian is shown there where most views see it on a surface that
    came from the same place, of like colour and from the side that its own state shows. It is contradicted where they
    see through it or its ends (it reaches over the edge of what it was labelled with), and where it lies on a surface
    that is not like it. Inside and behind, where nobody looks, nothing is, nor on a thin plate's other side, which
    hides it.
    lit: the state's Gaussians as the other's light has them (``as_lit_there``).  stacks: rendered depth of both states.
    """
    g, labels = states[state].gaussians, motions.labels[state]
    T = se3.inverse(motions.transforms) if state else motions.transforms
    stack, moving = stacks[1 - state], (labels > 0).nonzero().squeeze(1)
    on, through = (x.clone() for x in unmoved(g, stack, config.free_static))
    at, way = g.means.clone(), with_static(T).to(g.means)[labels[moving]]
    at[moving] = landed(g.means[moving], labels[moving], T)
    on[moving], through[moving] = met(stack, at[moving], config.free_moving)
    for end in ends(g[moving]):
        through[moving] |= met(stack, landed(end, labels[moving], T), config.free_static)[1]
    near = next_to(states[1 - state].gaussians, g, at, moving, stack)
    like, part = alike(states, motions, state, at, near, dc_to_rgb(lit.sh[:, 0]).clamp(0, 1), config)
    own = (way[:, :3, :3] @ seen_from(g, stacks[state], config.free_static)[moving].to(way)[..., None])[..., 0]
    same_side = (own * stack.seen_from(at[moving], config.free_moving)).sum(1) > 0
    behind = torch.zeros_like(on)
    behind[moving] = part[moving] & ~same_side
    like &= ~behind | ~on
    return ~through & (like | ~on | behind), ~through & like & on


def met(stack: DepthStack, points: Tensor, tau: float) -> tuple[Tensor, Tensor]:
    """[N] bool each: do most views of a state see these points [N, 3] on a surface, do they see through them? tau:
    tolerance (internal units)."""
    free, seen, _ = stack.counts(points.contiguous(), tau)
    return classify(free, seen)[1], classify(free, seen, need=4, ratio=2.0)[0]


def unmoved(g: GaussianTensors, stack: DepthStack, tau: float) -> tuple[Tensor, Tensor]:
    """``met`` by Gaussians [N] where they are and, seen through, also by their ends. Found once for a stack: no motion
    changes it."""
    known = _UNMOVED.get(stack)
    if known is None or known[0] is not g or known[1] != tau:
        on, through = met(stack, g.means, tau)
        for end in ends(g):
            through |= met(stack, end, tau)[1]
        known = _UNMOVED[stack] = (g, tau, on, through)
    return known[2], known[3]


def ends(g: GaussianTensors) -> list[Tensor]:
    """Where Gaussians end along their two long axes, four times [N, 3]."""
    R, scales = so3.quat_to_matrix(so3.quat_normalize(g.quats)), g.log_scales.exp()
    length, which = scales.topk(2, dim=1)
    axes = R.gather(2, which[:, None].expand(-1, 3, -1)) * (EXTENT * length)[:, None]
    return [g.means + sign * axes[..., a] for a in (0, 1) for sign in (1, -1)]


def next_to(other: GaussianTensors, g: GaussianTensors, at: Tensor, moving: Tensor, stack: DepthStack) -> Tensor:
    """[N, 4] the solid ones of ``other`` that are nearest to ``at`` [N, 3], where a motion carries ``g``, of which it
    moves the rows ``moving``; [N, 0] where there are fewer. Those of what stays are found once for the other state's
    ``stack``."""
    solid = other.solid.nonzero().squeeze(1)
    if len(solid) < NEIGHBOURS:
        return torch.zeros(len(at), 0, dtype=torch.int64)
    tree, known = other.means[solid].contiguous(), _NEAR.get(stack)
    if known is None or known[0] is not g or known[1] is not other:
        known = _NEAR[stack] = (g, other, solid[knn(tree, g.means.contiguous(), NEIGHBOURS)[1]])
    near = known[2].clone()
    near[moving] = solid[knn(tree, at[moving].contiguous(), NEIGHBOURS)[1]]
    return near


def alike(
    states: list[StateGaussians],
    motions: PartMotions,
    state: int,
    at: Tensor,
    near: Tensor,
    colours: Tensor,
    config: PolishConfig,
) -> tuple[Tensor, Tensor]:
    """[N] bool each, of the other state's Gaussians ``near`` [N, 4] to ``at`` [N, 3]: whether one came from where these
    are (to within ``config.free_moving``) and is of like colour (``colours`` [N, 3] in 0..1, mean of channels); whether
    one came from there at all."""
    other = states[1 - state].gaussians
    theirs = dc_to_rgb(other.sh[:, 0]).clamp(0, 1)
    apart = (theirs[near] - colours[:, None]).abs().mean(-1)
    T = with_static(se3.inverse(motions.transforms) if state else motions.transforms).to(at)
    places = se3.apply(T, states[state].gaussians.means)  # [K, N, 3]
    same = same_place(places, at, config.free_moving).gather(1, motions.labels[1 - state][near])
    return (same & (apart < config.other_colour)).any(1), same.any(1)


class ShownPixels:
    """How much of each pixel of a state's views is background or surface that the other state shows, too. Drawn when
    first asked for.

    shown [N] bool: which of the state's Gaussians are (``kept_and_shown``).
    """

    def __init__(self, state: StateGaussians, shown: Tensor, backend: str, device: torch.device | str = "cpu"):
        self.body = MovedGaussians(state.gaussians, torch.zeros(len(shown), dtype=torch.int64), device)
        self.shown, self.backend = shown[:, None].to(self.body.device, torch.float32), backend
        self.drawn: dict[tuple[int, int], Tensor] = {}

    @torch.no_grad()
    def __call__(self, view: int, level: int, camera: Camera) -> Tensor:
        """[H, W] in 0..1 of photograph ``view`` in size ``level``, of which this is the camera."""
        if (view, level) not in self.drawn:
            g = self.body.g
            out = self.body.render(
                g.means, self.body.quats, g.sh, camera, torch.zeros(3), self.backend, features=self.shown
            )
            self.drawn[view, level] = (out.painted[..., 0] + 1 - out.alpha.reshape(out.painted.shape[:2])).clamp(0, 1)
        return self.drawn[view, level]
