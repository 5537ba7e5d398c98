"""Fuse both states into the motion-aware canonical field and fine-tune its appearance (paper section 4.1, appendix)."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from p2gs.context import RunContext
from p2gs.data.base import Visit
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import CanonicalGaussians, PartMotions, StateGaussians
from p2gs.gaussians.pose import with_static
from p2gs.gaussians.splats import Splats
from p2gs.losses.base import Loss, LossInputs
from p2gs.models.canonical import CanonicalConfig, fuse, keep_rows
from p2gs.models.phase import register_phase
from p2gs.models.single_state import ImageConfig, ImagePhase, SplatRates
from p2gs.ops import se3
from p2gs.ops.carry import Parts, RigidMoves
from p2gs.parts.owners import hidden_to_owners
from p2gs.surface.openings import OpeningsConfig, open_up
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.evidence import evidence_of
from p2gs.visibility.free_space import SURFACE, explain_by_free_space, hidden_share


@dataclass
class CanonicalFusionConfig(ImageConfig):
    """Options of fusion and its fine-tuning. steps: paper 5,000. canonical: how the two states are joined. owners:
    whether what one state hides of moving parts goes to the part that hides it. openings: what becomes of surfaces that
    only one state shows and that nothing fixes in depth."""

    steps: int = 500
    levels: list[int] = field(default_factory=lambda: [200, 400])
    level_starts: list[float] = field(default_factory=lambda: [0.0, 0.3])
    rates: SplatRates = field(default_factory=lambda: SplatRates(2e-4, 2e-5, 2e-3, 2e-2, 1e-3, 2.5e-3, 2.5e-4))
    canonical: CanonicalConfig = field(default_factory=CanonicalConfig)
    owners: bool = True
    openings: OpeningsConfig = field(default_factory=OpeningsConfig)


@register_phase("canonical_fusion")
class CanonicalFusionPhase(ImagePhase):
    """Gaussians at canonical time, seen in both states through motions that are held fixed: discovered screws, or
    matched chords."""

    Config = CanonicalFusionConfig
    needs = ("states",)
    uses = ("sharpened", "motions")
    gives = "canonical"

    betas: Tensor
    transforms: Tensor

    @classmethod
    def build(cls, run: RunContext, section, *, states, sharpened=None, motions=None) -> "CanonicalFusionPhase":
        """``states`` tell what free space says: an overfitted lid explains noise that no wall behind it does."""
        found_in, states, stacks, counted = states, sharpened or states, None, {}
        if motions is not None and len(motions) and section.config.canonical.free_space > 0:
            backend = {"backend": run.rasterizer, "device": run.device}
            stacks = [DepthStack(e.depths, e.alphas, e.cameras) for e in evidence_of(run, found_in)]
            if section.config.owners:
                motions, counted["owners"] = hidden_to_owners(found_in, motions, stacks, **backend)
            train = run.scene.select(split="train")
            told = any(v.depth is not None for v in train)  # where depth is given nothing is open
            if section.config.openings.may_lose > 0 and not told:
                openings, motions, stacks, lids = open_up(
                    found_in, motions, run.views, stacks, section.config.openings, **backend
                )
                states = [opening.of(s) for opening, s in zip(openings, states, strict=True)]
                counted["openings"] = lids
                gone, come = (sum(c[k] for c in lids) for k in ("removed", "added"))
                run.log(cls.phase_name, f"{gone} Gaussians before openings gave way to {come} on the walls behind them")
        known = None if run.num_parts == "auto" else run.num_parts
        options = {"stacks": stacks, "counted": counted, "num_parts": known, **run.common()}
        return cls(section.config, section.losses, states, motions, run.views, **options)

    def __init__(
        self,
        config: CanonicalFusionConfig,
        losses: dict[str, Loss],
        states: list[StateGaussians],
        motions: PartMotions | None,
        views,
        stacks: list[DepthStack] | None = None,
        counted: dict | None = None,
        num_parts: int | None = None,
        **common,
    ):
        super().__init__(config, losses, views, **common)
        hidden = None
        if stacks is not None and motions is not None and config.canonical.hidden > 0:
            away = (motions.transforms, se3.inverse(motions.transforms))
            labels = motions.labels
            shares = [
                hidden_share(s.gaussians.means, labels[i], away[i], stacks[1 - i], SURFACE)
                for i, s in enumerate(states)
            ]
            hidden = (shares[0], shares[1])
        fused = fuse(states[0].gaussians, states[1].gaussians, motions, config.canonical, hidden, num_parts)
        if stacks is not None and motions is not None and fused.offsets is None and config.canonical.free_space > 0:
            T, tau = with_static(motions.transforms), config.canonical.free_space
            means = fused.gaussians.means
            labels, keep = explain_by_free_space(means, fused.labels, T, fused.canonical_times, stacks, tau)
            fused = keep_rows(fused, labels, keep)
        transforms = motions.transforms if motions is not None else torch.zeros(0, 4, 4).double()
        carried = {
            "labels": fused.labels,
            "margin": fused.margin,
            "paired": fused.paired,
            "mu0": fused.mu0,
            "mu1": fused.mu1,
        }
        if fused.offsets is not None:
            carried["offsets"] = fused.offsets
        self.splats = Splats(fused.gaussians, carried=carried)
        self.counted = {**fused.diagnostics, **(counted or {})}
        self.moves: list[RigidMoves] | None = None  # made when labels are where they stay
        self.register_buffer("betas", fused.betas)
        self.register_buffer("transforms", transforms)

    def parameter_groups(self):
        rates = self.config.rates.at(0.0)
        return {name: ([getattr(self.splats, name)], rates[name]) for name in rates}

    def learning_rates(self, step: int) -> dict[str, float]:
        return self.config.rates.at(step / max(self.total_steps, 1))

    def posed(self, state: int) -> GaussianTensors:
        """The Gaussians at state 0 or 1, with gradients."""
        g = self.splats.tensors()
        if hasattr(self.splats, "offsets"):
            return g.placed(g.means + self.splats.offsets[:, state], g.quats)
        if self.moves is None:
            parts = Parts(self.splats.labels)
            self.moves = [RigidMoves(parts, se3.screw_at(self.transforms, s - (1 - self.betas[1:]))) for s in (0, 1)]
        return g.placed(*self.moves[state](g.means, g.quats))

    def inputs(self, visit: Visit) -> LossInputs:
        camera, target = self.target(visit)
        render = self.render(self.posed(visit.state), camera, target.background)
        return LossInputs(
            visit.step, self.total_steps, self.splats.tensors(), render, target, camera, cache=self.loss_cache
        )

    def hand_over(self) -> CanonicalGaussians:
        s = self.splats
        offsets = s.offsets if hasattr(s, "offsets") else None
        return CanonicalGaussians(
            s.tensors().clone(), self.betas, s.labels, s.margin, s.paired, s.mu0, s.mu1, offsets, self.counted
        )

    @torch.no_grad()
    def preview(self, times: list[float]) -> dict[str, Tensor]:
        pictures = []
        for state in (0, 1):
            shot = self.picture(state)
            out = render_gaussians(
                self.posed(state), shot.camera, torch.ones(3, device=shot.image.device), backend=self.rasterizer
            )
            pictures.append(torch.cat([shot.image, out.colour], dim=1))
        height = min(p.shape[0] for p in pictures)
        return {f"fusion_state_{s}": (p[:height].clamp(0, 1) * 255).to(torch.uint8) for s, p in enumerate(pictures)}
