"""The stage between reconstruction and learning: find parts and motions, let the images decide, refine the screws.

Not a training phase of the paper: its ancestors need hand-made part centres or ground truth here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.models.discovery import DiscoveryConfig, discover
from p2gs.models.evidence import gather_evidence
from p2gs.models.handover import PartMotions, StateGaussians
from p2gs.models.phase import PHASES
from p2gs.models.screw_polish import PolishConfig, average_motion, photometric_cost, polish
from p2gs.ops import se3, so3
from p2gs.types import TwoStateScene


@dataclass
class PartMotionsConfig:
    """Options of part discovery.

    evidence_size: long edge of the rendered depth maps, pixels.  min_opacity: fainter Gaussians are no surface points.
    candidates: how many complete explanations are compared by re-rendering.  coarse: photometric refinement right after discovery.
    compare_types_below: a part that turns by less than this (degrees) is refined as a slide as well, and the images decide;
    freedom_penalty: relative image loss by which the freer type (revolute) must win.
    """

    evidence_size: int = 200
    min_opacity: float = 0.5
    candidates: int = 3
    compare_types_below: float = 20.0
    freedom_penalty: float = 0.002
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
    evidence = [gather_evidence(s.gaussians, scene.select(state=s.state, split="train"), config.evidence_size, config.min_opacity, backend, device) for s in states]
    say("looking for parts")
    found = discover(evidence[0], evidence[1], num_parts, config.search, seed, progress=report)
    explanations = _explanations(found)[: max(config.candidates, 1)]
    best, costs, level = None, [], config.coarse.levels[-1]
    for number, explanation in enumerate(explanations):
        motions = _label_states(explanation, states)
        if len(explanations) > 1:
            say(f"re-rendering explanation {number + 1} of {len(explanations)}")
        motions = refine(states, motions, views, config.coarse, seed=seed, backend=backend, device=device)
        cost = explanation_cost(states, motions, views, level, backend, device)
        costs.append(cost)
        if best is None or cost < best[0]:
            best = (cost, motions, number)
    motions = best[1]
    motions = settle_types(states, motions, views, config, seed=seed, backend=backend, device=device)
    motions.diagnostics = {"explanation": best[2], "photometric_costs": costs, **_plain(found.diagnostics)}
    return motions


def _explanations(found) -> list:
    """The chosen explanation first, then the alternatives."""
    return [found, *[c for c in found.candidates if c is not found]]


def _label_states(explanation, states: list[StateGaussians]) -> PartMotions:
    """Label every Gaussian (also the faint ones) of both states."""
    from p2gs.ops.sh import dc_to_rgb

    labels, margin = [], []
    for state, s in enumerate(states):
        lab, mar = explanation.label_points(s.gaussians.means, dc_to_rgb(s.gaussians.sh[:, 0]).clamp(0, 1), state)
        labels.append(torch.as_tensor(lab, dtype=torch.int64))
        margin.append(torch.as_tensor(mar, dtype=torch.float32))
    types = [m.type for m in explanation.motions]
    transforms = torch.stack([torch.as_tensor(m.transform, dtype=torch.float64) for m in explanation.motions]) if types else torch.zeros(0, 4, 4).double()
    confidence = torch.tensor([float(m.confidence) for m in explanation.motions])
    return PartMotions(types, transforms, confidence, labels, margin)


def polish_labels(motions: PartMotions, state: int, min_margin: float) -> Tensor:
    """Labels of one state with the ambiguous Gaussians left out (-1)."""
    return torch.where(motions.margin[state] >= min_margin, motions.labels[state], -1)


def refine(states, motions: PartMotions, views, config: PolishConfig, *, seed: int, backend: str, device="cpu", types=None, both: bool = True) -> PartMotions:
    """Photometric refinement of all motions: start Gaussians into the end images, then end Gaussians into the start images; the mean of both."""
    if config.steps <= 0 or len(motions) == 0:
        return motions
    types = types or motions.types
    forward, _ = polish(
        states[0].gaussians, polish_labels(motions, 0, config.min_margin), motions.transforms, types, views[1], config, seed=seed, backend=backend, device=device
    )
    result = forward
    if both:
        backward, _ = polish(
            states[1].gaussians, polish_labels(motions, 1, config.min_margin), se3.inverse(forward), types, views[0], config, seed=seed + 1, backend=backend, device=device
        )
        result = torch.stack([average_motion(a, se3.inverse(b)) for a, b in zip(forward, backward)])
    return PartMotions(motions.types, result, motions.confidence, motions.labels, motions.margin, motions.diagnostics)


def explanation_cost(states, motions: PartMotions, views, level: int, backend: str, device="cpu") -> float:
    """Image loss of each state's Gaussians moved into the other state's photographs, both directions averaged."""
    there = photometric_cost(states[0].gaussians, motions.labels[0], motions.transforms, views[1], level=level, backend=backend, device=device)
    back = photometric_cost(states[1].gaussians, motions.labels[1], se3.inverse(motions.transforms), views[0], level=level, backend=backend, device=device)
    return 0.5 * (there + back)


def settle_types(states, motions: PartMotions, views, config: PartMotionsConfig, *, seed: int, backend: str, device="cpu") -> PartMotions:
    """Fit both joint types where the angle leaves room for doubt, keep the one the images prefer; then refine with the types held."""
    level = config.coarse.levels[-1]
    for k in range(len(motions)):
        angle = float(so3.rotation_angle(motions.transforms[k, :3, :3])) * 57.29578
        if motions.types[k] != "revolute" or angle >= config.compare_types_below:
            continue
        slide = motions.transforms.clone()
        own = states[0].gaussians.means[motions.labels[0] == k + 1].double()
        centre = own.mean(0) if len(own) else torch.zeros(3).double()
        slide[k] = torch.eye(4).double()
        slide[k, :3, 3] = motions.transforms[k, :3, :3] @ centre + motions.transforms[k, :3, 3] - centre
        types = [*motions.types[:k], "prismatic", *motions.types[k + 1 :]]
        other = PartMotions(types, slide, motions.confidence, motions.labels, motions.margin, motions.diagnostics)
        other = refine(states, other, views, config.coarse, seed=seed, backend=backend, device=device)
        if explanation_cost(states, other, views, level, backend, device) <= explanation_cost(states, motions, views, level, backend, device) * (1 + config.freedom_penalty):
            motions = other
    return motions


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
