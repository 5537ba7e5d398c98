"""The stage between reconstruction and learning: find parts and motions, let the images decide, refine the screws.

Not a training phase of the paper: its ancestors need hand-made part centres or ground truth here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.models.discovery import DiscoveryConfig, discover
from p2gs.models.discovery.evidence import DepthStack
from p2gs.models.evidence import gather_evidence
from p2gs.models.free_space import seen_through
from p2gs.models.handover import PartMotions, StateGaussians
from p2gs.models.phase import PHASES
from p2gs.models.screw_polish import PolishConfig, Side, photometric_cost, polish
from p2gs.ops import se3, so3
from p2gs.ops.knn import knn
from p2gs.types import TwoStateScene, UserError


@dataclass
class PartMotionsConfig:
    """Options of part discovery.

    evidence_size: long edge of the rendered depth maps, pixels.  min_opacity: fainter Gaussians are no surface points.
    candidates: how many complete explanations are compared by re-rendering.  coarse: photometric refinement right after discovery.
    compare_types_below: a part that turns by less than this (degrees) is refined as a slide as well, and the images decide;
    freedom_penalty: relative image loss by which a turn must win against a slide.  part_penalty: the same for a further part.
    same_motion, merge_penalty: two touching parts whose motions carry them this near to each other (internal units) become one
    unless the image loss rises by more than this share.
    """

    evidence_size: int = 200
    min_opacity: float = 0.5
    candidates: int = 3
    compare_types_below: float = 45.0
    freedom_penalty: float = 0.002
    part_penalty: float = 0.006
    same_motion: float = 0.04
    merge_penalty: float = 0.012
    search: DiscoveryConfig = field(default_factory=DiscoveryConfig)
    coarse: PolishConfig = field(default_factory=lambda: PolishConfig(steps=150, levels=[100, 200], rate=1e-2))


@PHASES.register("discovery")
class DiscoveryStage:
    """A stage without training: no losses, no callbacks."""

    Config = PartMotionsConfig
    trained = False


def find_part_motions(
    states: list[StateGaussians],
    scene: TwoStateScene,
    views: dict[int, TrainingViews],
    num_parts,
    config: PartMotionsConfig,
    *,
    seed: int,
    backend: str = "auto",
    device: torch.device | str = "cpu",
    report=None,
) -> PartMotions:
    """Parts, motions and labels of every Gaussian of both states, from the reconstructions and the images alone."""
    say = report or (lambda text: None)
    say("rendering depth of both states")
    evidence = [
        gather_evidence(s.gaussians, scene.select(state=s.state, split="train"), config.evidence_size, config.min_opacity, backend, device)
        for s in states
    ]
    for s, seen in zip(states, evidence, strict=True):
        if len(seen.points) < 10 or not any(bool((d > 0).any()) for d in seen.depths):
            name = ("start", "end")[s.state]
            raise UserError(f"discovery: the {name} reconstruction shows nothing opaque; expected an object (train single_state longer)")
    stacks = [DepthStack(e.depths, e.alphas, e.cameras) for e in evidence]
    say("looking for parts")
    found = discover(evidence[0], evidence[1], num_parts, config.search, seed, progress=report)
    explanations = _explanations(found)[: max(config.candidates, 1)]
    best, costs, tried, level = None, [], [], config.coarse.levels[-1]
    for number, explanation in enumerate(explanations):
        motions = _label_states(explanation, states)
        if len(explanations) > 1:
            say(f"re-rendering explanation {number + 1} of {len(explanations)}")
        motions = refine(states, motions, views, config.coarse, stacks, seed=seed, backend=backend, device=device)
        reductions: list[dict] = []
        motions = simplify(states, motions, views, config, backend=backend, device=device, log=reductions)
        cost = explanation_cost(states, motions, views, level, backend, device)
        costs.append(cost)
        rank = cost * (1 + config.part_penalty) ** len(motions)
        tried.append({"types": motions.types, "cost": cost, "rank": rank, "reductions": reductions})
        if best is None or rank < best[0]:
            best = (rank, motions, number)
    motions = best[1]
    motions = settle_types(states, motions, views, config, stacks, seed=seed, backend=backend, device=device)
    motions.diagnostics = {
        "explanation": best[2],
        "photometric_costs": costs,
        "explanations": tried,
        "evidence": [found.evidence_start.to(torch.int8), found.evidence_end.to(torch.int8)],  # of the Gaussians above min_opacity
        "min_opacity": config.min_opacity,
        **_plain(found.diagnostics),
    }
    return motions


def _explanations(found) -> list:
    """The chosen explanation first, then the alternatives that differ from it."""

    def signature(e):
        return [(m.type, torch.as_tensor(m.transform).double().round(decimals=4).tolist()) for m in e.motions]

    return [found, *[c for c in found.candidates if signature(c) != signature(found)]]


def _label_states(explanation, states: list[StateGaussians]) -> PartMotions:
    """Label every Gaussian (also the faint ones) of both states."""
    from p2gs.ops.sh import dc_to_rgb

    labels, margin = [], []
    for state, s in enumerate(states):
        lab, mar = explanation.label_points(s.gaussians.means, dc_to_rgb(s.gaussians.sh[:, 0]).clamp(0, 1), state)
        labels.append(torch.as_tensor(lab, dtype=torch.int64))
        margin.append(torch.as_tensor(mar, dtype=torch.float32))
    types = [m.type for m in explanation.motions]
    transforms = (
        torch.stack([torch.as_tensor(m.transform, dtype=torch.float64) for m in explanation.motions])
        if types
        else torch.zeros(0, 4, 4).double()
    )
    confidence = torch.tensor([float(m.confidence) for m in explanation.motions])
    return PartMotions(types, transforms, confidence, labels, margin)


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
        sides.append(Side(g, labels, views[1 - s], back=s == 1))
    return sides


def refine(
    states, motions: PartMotions, views, config: PolishConfig, stacks: list[DepthStack], *, seed: int, backend: str, device="cpu"
) -> PartMotions:
    """Photometric refinement of all motions, both directions at once."""
    if config.steps <= 0 or len(motions) == 0:
        return motions
    sides = sides_of(states, motions, views, config, stacks)
    result, _ = polish(sides, motions.transforms, motions.types, config, seed=seed, backend=backend, device=device)
    return PartMotions(motions.types, result, motions.confidence, motions.labels, motions.margin, motions.diagnostics)


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


def simplify(
    states, motions: PartMotions, views, config: PartMotionsConfig, *, backend: str, device="cpu", log: list[dict] | None = None
) -> PartMotions:
    """Make one of touching parts with one motion, and drop parts without which the images are explained as well.

    log: told of each part that goes: what was done, its type, image loss with and without it, the loss that was allowed.
    """
    cost = explanation_cost(states, motions, views, config.coarse.levels[-1], backend, device)
    tried: set[tuple] = set()
    while len(motions):
        found = None
        for change, reduced in _reductions(states, motions, config.same_motion):
            if change in tried:
                continue
            tried.add(change)
            lower = explanation_cost(states, reduced, views, config.coarse.levels[-1], backend, device)
            penalty = config.merge_penalty if change[0] == "merge" else config.part_penalty
            if lower <= cost * (1 + penalty):
                found = (reduced, lower)
                if log is not None:
                    gone = {"change": change[0], "type": motions.types[change[1]], "cost_with": cost, "cost_without": lower}
                    log.append({**gone, "allowed": cost * (1 + penalty)})
                break
        if found is None:
            return motions
        motions, cost = found[0], min(cost, found[1])
        tried.clear()
    return motions


def _reductions(states, motions: PartMotions, same_motion: float):
    """Explanations with one part less: (what changed, motions). Merging comes first, small parts go before large ones."""
    solid = [torch.sigmoid(s.gaussians.opacity_logits) > 0.5 for s in states]
    points = [states[0].gaussians.means[solid[0] & (motions.labels[0] == k + 1)].double() for k in range(len(motions))]
    order = sorted(range(len(motions)), key=lambda k: len(points[k]))
    for i, small in enumerate(order):
        for large in reversed(order[i + 1 :]):
            if min(len(points[small]), len(points[large])) < 5:
                continue
            gap = se3.apply(motions.transforms[small], points[small]) - se3.apply(motions.transforms[large], points[small])
            if float(gap.norm(dim=1).mean()) < same_motion and _touch(points[small], points[large]):
                yield ("merge", small, large), without_part(motions, small, large + 1)
    for small in order:
        yield ("drop", small), without_part(motions, small, 0)


def _touch(a: Tensor, b: Tensor) -> bool:
    """Whether two point sets [N, 3], [M, 3] come as near to each other somewhere as the smaller one's points are to theirs."""
    if len(a) > len(b):
        a, b = b, a
    spacing = knn(a, None, 1, True)[0].median()
    return float(knn(b, a, 1, False)[0].quantile(0.02)) < 3 * float(spacing)


def without_part(motions: PartMotions, index: int, into: int) -> PartMotions:
    """The same motions without entry ``index``; its Gaussians get label ``into`` (numbered as before: 0 static, k + 1 for entry k)."""
    keep = [k for k in range(len(motions)) if k != index]
    renumber = torch.zeros(len(motions) + 1, dtype=torch.int64)
    for new, old in enumerate(keep):
        renumber[old + 1] = new + 1
    renumber[index + 1] = renumber[into]
    labels = [renumber[old] for old in motions.labels]
    return PartMotions(
        [motions.types[k] for k in keep], motions.transforms[keep], motions.confidence[keep], labels, motions.margin, motions.diagnostics
    )


def settle_types(
    states, motions: PartMotions, views, config: PartMotionsConfig, stacks: list[DepthStack], *, seed: int, backend: str, device="cpu"
) -> PartMotions:
    """Fit both joint types where the angle leaves room for doubt, keep the one the images prefer; then refine with the types held."""
    level = config.coarse.levels[-1]

    def cost(m: PartMotions) -> float:
        return explanation_cost(states, m, views, level, backend, device)

    best = None
    for k in range(len(motions)):
        angle = float(so3.rotation_angle(motions.transforms[k, :3, :3])) * 57.29578
        if motions.types[k] != "revolute" or angle >= config.compare_types_below:
            continue
        best = cost(motions) if best is None else best
        other = min(_as_slides(states, motions, k), key=cost)
        other = refine(states, other, views, config.coarse, stacks, seed=seed, backend=backend, device=device)
        found = cost(other)
        if found <= best * (1 + config.freedom_penalty):
            motions, best = other, found
    return motions


def _as_slides(states, motions: PartMotions, k: int) -> list[PartMotions]:
    """The same with part k a slide that carries its middle where it goes, or as far as that is along the slide of another part."""
    own = states[0].gaussians.means[motions.labels[0] == k + 1].double()
    centre = own.mean(0) if len(own) else torch.zeros(3).double()
    way = se3.apply(motions.transforms[k], centre[None])[0] - centre
    ways = [way]
    for i, kind in enumerate(motions.types):
        if kind == "prismatic":
            along = torch.nn.functional.normalize(motions.transforms[i, :3, 3], dim=0)
            ways += [along * (way @ along), along * way.norm() * torch.sign(way @ along)]
    out = []
    for w in ways:
        T = motions.transforms.clone()
        T[k] = torch.eye(4).double()
        T[k, :3, 3] = w
        types = [*motions.types[:k], "prismatic", *motions.types[k + 1 :]]
        out.append(PartMotions(types, T, motions.confidence, motions.labels, motions.margin, motions.diagnostics))
    return out


def _plain(value):
    """Only what a checkpoint loads without code: numbers, text, lists, dicts."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, Tensor):
        return value.detach().cpu()
    if isinstance(value, (bool, int, float, str)) or value is None:
        return value
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return str(value)
