"""Part motions against the photographs: which Gaussians have a say, refinement of all motions at once, what an explanation costs."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from p2gs.models.discovery.evidence import DepthStack
from p2gs.models.discovery.pipeline import SurfaceStacks
from p2gs.models.free_space import seen_through
from p2gs.models.handover import PartMotions
from p2gs.models.screw_polish import PolishConfig, Side, allowed_step, apply_step, photometric_cost, polish
from p2gs.ops import se3

# Change of the mean landing cost (0..1) that is none: by so much a plate's true motion may land worse than one 2.7 degrees off
# (zoo dishwasher_12428_wide); one that photographs pulled 10 degrees off lands 0.055 worse (oven_101943).
NOISE = 0.04


def polish_labels(motions: PartMotions, state: int, min_margin: float) -> Tensor:
    """Labels of one state with the ambiguous Gaussians left out (-1)."""
    return torch.where(motions.margin[state] >= min_margin, motions.labels[state], -1)


def sides_of(states, motions: PartMotions, views, config: PolishConfig, stacks: list[DepthStack]) -> list[Side]:
    """Both directions: the start's Gaussians against the end's photographs, and the reverse.

    stacks: rendered depth of both states. What the other state sees through is left out: no motion can make it fit.
    """
    sides = []
    for s in (0, 1):
        g, labels = states[s].gaussians, polish_labels(motions, s, config.min_margin)
        if config.free_static > 0 and config.free_moving > 0:
            T = se3.inverse(motions.transforms) if s else motions.transforms
            through = seen_through(g.means, motions.labels[s], T, stacks[1 - s], config.free_static, config.free_moving)
            labels = torch.where(through, -1, labels)
        seen_from = stacks[s].seen_from(g.means.detach().cpu(), config.free_static or 0.02) if config.front > -1 else None
        sides.append(Side(g, labels, views[1 - s], s == 1, seen_from))
    return sides


def refine(
    states, motions: PartMotions, views, config: PolishConfig, stacks: list[DepthStack], *, seed: int, backend: str, device="cpu"
) -> PartMotions:
    """Photometric refinement of all motions, both directions at once."""
    if config.steps <= 0 or len(motions) == 0:
        return motions
    sides = sides_of(states, motions, views, config, stacks)
    result, _ = polish(sides, motions.transforms, motions.types, config, seed=seed, backend=backend, device=device)
    if isinstance(stacks, SurfaceStacks):
        result = uncontradicted(states, motions, result, stacks)
    return replace(motions, transforms=result)


def uncontradicted(states, motions: PartMotions, refined: Tensor, surfaces: SurfaceStacks) -> Tensor:
    """The refined motions [K-1, 4, 4], but of plates of which the states show different sides (to know the other side explains more than
    ``NOISE``) what they were where the surface arrives worse now: photographs pull such a plate to where neither state has it."""
    labels = surfaces.surfel_labels([s.gaussians.means.detach().cpu() for s in states], motions.labels)
    out = refined.clone()
    for k in range(len(motions)):
        (before, other_side), (after, _) = (surfaces.arrival(labels, T, motions.types, k) for T in (motions.transforms, refined))
        if other_side > NOISE and after > before + NOISE:
            out[k] = motions.transforms[k]
    return out


def single_ways(
    states, motions: PartMotions, views, config: PolishConfig, stacks: list[DepthStack], *, seed: int, backend: str, device="cpu"
) -> dict:
    """Where each direction alone takes refined motions: {"forward", "backward"} [K-1, 4, 4], both start -> end.

    A third of the polish's steps at half its rate. How far the two come apart tells how sure the photographs are.
    """
    if config.steps <= 0 or len(motions) == 0:
        return {}
    short = replace(config, steps=max(config.steps // 3, 1), rate=config.rate / 2)
    sides = sides_of(states, motions, views, config, stacks)
    found = [polish([side], motions.transforms, motions.types, short, seed=seed, backend=backend, device=device) for side in sides]
    return {name: T for name, (T, _) in zip(("forward", "backward"), found, strict=True)}


def explanation_cost(states, motions: PartMotions, views, level: int, backend: str, device="cpu") -> float:
    """Image loss of each state's Gaussians moved into the other state's photographs, both directions averaged."""
    there = photometric_cost(
        states[0].gaussians, motions.labels[0], motions.transforms, views[1], level=level, backend=backend, device=device
    )
    back = photometric_cost(
        states[1].gaussians, motions.labels[1], se3.inverse(motions.transforms), views[0], level=level, backend=backend, device=device
    )
    return 0.5 * (there + back)


def survey(
    states, motions: PartMotions, views, level: int, reach: list[float], *, backend: str, device="cpu"
) -> tuple[PartMotions, list[int]]:
    """Lay each part, shifted within its own surface, where the images are explained best; the refinement goes on from there.

    A plain door shifted along itself still covers most of its place: a minimum of its own, centimetres from the true one, that no
    descent leaves. reach: shifts tried to both sides of the part's two long directions (internal units).  Returns the motions
    and which of them moved.
    """
    best = explanation_cost(states, motions, views, level, backend, device)
    moved = []
    for k in range(len(motions)):
        points = states[0].gaussians.means[motions.labels[0] == k + 1].double().cpu()
        if len(points) < 10:
            continue
        at = se3.apply(motions.transforms[k], points)
        centre = at.mean(0)
        radius = float((at - centre).square().sum(1).mean().sqrt())
        found = None
        for way in torch.linalg.svd(at - centre, full_matrices=False)[2][:2]:
            for size in [sign * r for r in reach for sign in (1, -1)]:
                shift = torch.cat([torch.zeros(3, dtype=torch.float64), way * size])
                step = allowed_step([motions.types[k]], motions.transforms[k : k + 1], centre[None], torch.tensor([radius]), shift[None])[0]
                if float(step[3:].norm()) < 0.5 * abs(size):
                    continue
                T = apply_step(motions.transforms[k], centre, radius, step)
                T = se3.project_revolute(T) if motions.types[k] == "revolute" else T
                tried = motions.with_motion(k, motions.types[k], T)
                cost = explanation_cost(states, tried, views, level, backend, device)
                if cost < best:
                    best, found = cost, tried
        if found is not None:
            motions = found
            moved.append(k)
    return motions, moved


def leave_false_minima(
    states,
    motions: PartMotions,
    views,
    config: PolishConfig,
    stacks: list[DepthStack],
    reach: list[float],
    *,
    seed: int,
    backend: str,
    device="cpu",
) -> tuple[PartMotions, list[int]]:
    """Refined motions once more from where ``survey`` lays the parts, kept if that explains the images better.

    Returns them and which parts moved.
    """
    if config.steps <= 0 or not reach or len(motions) == 0:
        return motions, []
    level = config.levels[0]
    surveyed, moved = survey(states, motions, views, level, reach, backend=backend, device=device)
    if not moved:
        return motions, []
    surveyed = refine(states, surveyed, views, config, stacks, seed=seed, backend=backend, device=device)
    before, after = (explanation_cost(states, m, views, config.levels[-1], backend, device) for m in (motions, surveyed))
    return (surveyed, moved) if after < before else (motions, [])
