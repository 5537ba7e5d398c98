"""The stage between reconstruction and learning: find parts and motions, let the images decide, refine the screws.

Not a training phase of the paper: its ancestors need hand-made part centres or ground truth here.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from p2gs.context import RunContext
from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.models.stage import Stage, register_phase
from p2gs.motion.directions import directions_of
from p2gs.motion.discovery import Discovery, StateEvidence, discover, relabel
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import label_gaussians
from p2gs.motion.survey import leave_false_minima
from p2gs.native import at_once
from p2gs.parts.askew import lay_axes
from p2gs.parts.bodies import Surfaces, looked_through, one_part_a_body
from p2gs.parts.expand import expand
from p2gs.parts.fronts import part_fronts
from p2gs.parts.fuse import fuse
from p2gs.parts.options import PartMotionsConfig
from p2gs.parts.part_choices import better, settle_types, simplify
from p2gs.parts.seams import join_seamless
from p2gs.parts.seek import seek
from p2gs.parts.settle import reconsider, settle_labels
from p2gs.parts.side_by_side import part_side_by_side
from p2gs.parts.slots import merge_to
from p2gs.types import TwoStateScene, UserError
from p2gs.visibility.evidence import gather_evidence


def find_part_motions(
    states: list[StateGaussians],
    scene: TwoStateScene,
    views: dict[int, TrainingViews],
    num_parts,
    config: PartMotionsConfig,
    *,
    sharpened: list[StateGaussians] | None = None,
    seed: int,
    backend: str = "auto",
    device: torch.device | str = "cpu",
    report=None,
) -> PartMotions:
    """Parts, motions and labels of every Gaussian of both states, from the reconstructions and the images alone.

    sharpened: the same Gaussians with their surfaces sharpened, for what hangs on a few thousandths (None: these).
    """
    say = report or (lambda text: None)
    options = {"seed": seed, "backend": backend, "device": device}
    say("rendering depth of both states")
    evidence = _evidence(states, scene, config, backend, device)
    say("looking for parts")
    found = discover(evidence[0], evidence[1], num_parts, config.search, seed, progress=report)
    judge = Judge(found, states, views, config.coarse, found.problem.stacks, further=config.part_penalty, **options)
    explanations, looks = _looked_at(judge, _explanations(found), config, say)
    limit = (config.search.max_parts if num_parts == "auto" else num_parts) - 1
    motions, compared = _compared(judge, explanations, limit, config, say)
    motions, expanded = expand(judge, motions)
    known = len(motions)
    motions, improved = _improved(judge, motions, limit, config, say)
    if len(motions) > known:  # what came may be a piece of another
        motions, later = expand(judge, motions)
        expanded += later
    say("settling labels and motions")
    motions, rounds = settle_labels(judge, motions, config)
    motions, neighbours = _neighbours(judge, found, motions, sharpened or states, limit)
    motions, _, laid = lay_axes(judge, motions, config.askew, config.part_penalty)
    motions.diagnostics = {
        "first_looks": looks,
        # of the Gaussians above min_opacity
        "evidence": [found.evidence_start.to(torch.int8), found.evidence_end.to(torch.int8)],
        "min_opacity": config.min_opacity,
        **compared,
        "expanded": expanded,
        **improved,
        "rounds": rounds,
        **neighbours,
        "laid": laid,
        **_plain(found.diagnostics),
    }
    return motions


def _evidence(
    states: list[StateGaussians], scene: TwoStateScene, config: PartMotionsConfig, backend: str, device
) -> list[StateEvidence]:
    """Surface points and rendered depth of both states. Raises UserError where there are none."""
    out = []
    for s in states:
        seen = scene.select(state=s.state, split="train")
        out.append(gather_evidence(s.gaussians, seen, config.evidence_size, config.min_opacity, backend, device))
        if len(out[-1].points) < 10 or not any(bool((d > 0).any()) for d in out[-1].depths):
            name = ("start", "end")[s.state]
            raise UserError(
                f"discovery: the {name} reconstruction shows nothing opaque; expected an object (train single_state "
                "longer)"
            )
    return out


def _looked_at(judge: Judge, explanations: list, config: PartMotionsConfig, say) -> tuple[list, list[float]]:
    """The ``candidates`` explanations that look best after a few steps at the smallest size, and the energies of all
    then."""
    if len(explanations) <= config.candidates:
        return explanations, []
    say(f"a quick look at {len(explanations)} explanations")
    quick = judge.at_a_glance(config.look_steps)
    looks = at_once(lambda e: quick(quick.refine(_label_states(e, judge.states)))[0], explanations)
    order = sorted(range(len(explanations)), key=looks.__getitem__)[: max(config.candidates, 1)]
    return [explanations[i] for i in order], looks


def _compared(judge: Judge, explanations: list, limit: int, config: PartMotionsConfig, say) -> tuple[PartMotions, dict]:
    """The best explanation (``better``), refined, without parts that it is better without and with those of the others
    that it is better with; which it was, and of each the image loss and how much higher its energy is ("rank")."""
    if len(explanations) > 1:
        say(f"re-rendering {len(explanations)} explanations")

    def simplified(explanation) -> tuple[PartMotions, dict]:
        reductions: list[dict] = []
        better = judge.improved(_label_states(explanation, judge.states))[2]
        motions = simplify(judge, better, config.same_motion, reductions)
        return motions, {"types": motions.types, "cost": judge.cost(motions), "reductions": reductions}

    looked, chosen = at_once(simplified, explanations), 0
    refined, tried = [motions for motions, _ in looked], [told for _, told in looked]
    for number, motions in enumerate(refined):
        if better(judge, motions, refined[chosen]):
            chosen = number
    for one, motions in zip(tried, refined, strict=True):
        one["rank"] = judge.gain(refined[chosen], motions)
    motions, fused = fuse(judge, refined[chosen], refined, limit, config.same_motion)
    return motions, {"explanation": chosen, "explanations": tried, "fused": fused}


def _improved(
    judge: Judge, motions: PartMotions, limit: int, config: PartMotionsConfig, say
) -> tuple[PartMotions, dict]:
    """Types settled, bodies told apart, false minima left, each part reconsidered; what was done."""
    motions = settle_types(judge, motions, config.compare_types_below, config.freedom_penalty)
    motions, changed = _bodies(judge, motions, limit)
    motions, shifted = leave_false_minima(judge, motions, config.survey, config.candidates)
    if config.reconsider:
        say("reconsidering each part")
        motions, reconsidered = reconsider(judge, motions, limit, config)
        changed += reconsidered
        motions = simplify(judge, motions, config.same_motion, changed)
    if config.seek > 0:
        say("looking for what no part explains")
        known = len(motions)
        motions, sought = seek(judge, motions, limit, config)
        changed += sought
        if len(motions) > known:
            motions, bodies = _bodies(judge, motions, limit)
            changed += bodies
    return motions, {"shifted": shifted, "reconsidered": changed}


def _neighbours(
    judge: Judge, found: Discovery, motions: PartMotions, sharpened: list[StateGaussians], limit: int
) -> tuple[PartMotions, dict]:
    """Parts that touch and go alike as one where they are one body, as two where they are two; what was done."""
    states, problem, apart = judge.states, found.problem, found.problem.scale.apart
    surfels, look = problem.surfels, partial(looked_through, stacks=problem.stacks, tau=problem.scale.tau)
    faced = directions_of(states, motions) if "prismatic" in motions.types else torch.zeros(0, 3).double()
    motions, beside = part_side_by_side(states, surfels, motions, faced, apart, limit, look)
    if beside:
        motions = judge.improved(motions)[2]
    motions, seamless = join_seamless(judge, motions, [tuple(split["parts"]) for split in beside])
    motions, fronts = part_fronts(judge, sharpened, surfels, motions, faced, apart, limit)
    return motions, {"side_by_side": beside, "seamless": seamless, "fronts": fronts}


def _bodies(judge: Judge, motions: PartMotions, limit: int) -> tuple[PartMotions, list[dict]]:
    """Parts that are several bodies told apart, and refined where there were any: those that a look goes between, and
    such as only another part's surface separates where the energy falls by it; what was done."""
    told: list[dict] = []
    surfaces = labelled_surfaces(judge.found, motions.transforms, motions.types)
    for held in (False, True):
        tried, bodies = one_part_a_body(judge.states, motions, surfaces, limit, held)
        if not bodies:
            continue
        tried = judge.improved(tried)[2]
        gained = judge.gain(tried, motions)
        told += [{"change": "one part a body", **b, "seen_between": not held, "energy": -gained} for b in bodies]
        if not held or gained > 0:
            motions, surfaces = tried, labelled_surfaces(judge.found, tried.transforms, tried.types)
    return motions, told


def labelled_surfaces(found: Discovery, transforms: Tensor, types: list[str]) -> Surfaces:
    """Both states' surfels, each with the part that it chooses amid motions ``transforms`` [K, 4, 4] of ``types``."""
    explanation, problem = relabel(found, transforms, types), found.problem
    points, labels = [s.points for s in problem.surfels], [p.argmax(1) for p in explanation.probability]
    return Surfaces(points, labels, problem.scale.spacing, problem.stacks, problem.scale.tau)


def _explanations(found) -> list:
    """The chosen explanation first, then the alternatives that differ from it."""

    def signature(e):
        return [(m.type, torch.as_tensor(m.transform).double().round(decimals=4).tolist()) for m in e.motions]

    return [found, *[c for c in found.candidates if signature(c) != signature(found)]]


def _label_states(explanation, states: list[StateGaussians]) -> PartMotions:
    """An explanation's motions with the label of every Gaussian."""
    labels, margin = label_gaussians(explanation, states)
    types = [m.type for m in explanation.motions]
    transforms = (
        torch.stack([torch.as_tensor(m.transform, dtype=torch.float64) for m in explanation.motions])
        if types
        else torch.zeros(0, 4, 4).double()
    )
    confidence = torch.tensor([float(m.confidence) for m in explanation.motions])
    return PartMotions(types, transforms, confidence, labels, margin)


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


@register_phase("discovery")
class DiscoveryStage(Stage):
    """Parts and motions, from both states' reconstructions and photographs: no training, so no losses, no callbacks."""

    Config = PartMotionsConfig
    trained = False

    needs = ("states",)
    uses = ("sharpened",)
    gives = "motions"

    @classmethod
    def wanted(cls, run: RunContext) -> bool:
        return run.init == "discovery"

    @classmethod
    def num_parts_key(cls, run: RunContext) -> Any:
        """With ``exact_parts`` discovery finds what there is; later stages take it to the number that was asked for."""
        return "auto" if run.exact else run.num_parts

    @classmethod
    def compute(
        cls, run: RunContext, section, *, states: list[StateGaussians], sharpened: list[StateGaussians] | None = None
    ) -> PartMotions:
        return find_part_motions(
            states,
            run.scene,
            run.views,
            "auto" if run.exact else run.num_parts,
            section.config,
            sharpened=sharpened,
            seed=run.seed,
            backend=run.rasterizer,
            device=run.device,
            report=partial(run.log, cls.phase_name),
        )

    @classmethod
    def hand_on(cls, run: RunContext, value: PartMotions, *, states: list[StateGaussians], **given) -> dict:
        if run.exact:
            value, notes = merge_to(value, states, run.num_parts)
            for note in notes:
                print(note, flush=True)
        return {cls.gives: value}
