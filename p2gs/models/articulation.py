"""Learn parts and joints: Gaussians, part embeddings and screws together (paper sections 4.2-4.4, total objective)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from p2gs.context import RunContext
from p2gs.data.base import Visit
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import Articulation, CanonicalGaussians, PartMotions, StateGaussians
from p2gs.gaussians.pose import carry
from p2gs.gaussians.splats import Splats
from p2gs.losses.base import Loss, LossInputs, PartState
from p2gs.models.articulation_options import ArticulationConfig
from p2gs.models.observed_pairs import ObservedPairs
from p2gs.models.part_head import PartHead, random_embeddings
from p2gs.models.phase import register_phase
from p2gs.models.repel import place_repel_points
from p2gs.models.single_state import ImagePhase
from p2gs.motion.screws import PartScrews, blend_move, initial_screws
from p2gs.ops import se3
from p2gs.ops.decay import exponential
from p2gs.ops.knn import knn
from p2gs.parts.slots import add_spare
from p2gs.types import GaussianTensors, UserError


def check_losses(config: ArticulationConfig, losses: dict[str, Loss], canonical: CanonicalGaussians) -> None:
    """Raises UserError where losses that are switched on would be nothing, without a word."""
    vanish = sorted(name for name, loss in losses.items() if "pairs" in loss.needs and loss.weight != 0)
    late = config.pair_target != "nearest" or config.nearest_from > 0
    if vanish and late and not bool(canonical.paired.any()):
        raise UserError(
            f"phases.articulation.losses: {', '.join(vanish)} need observed pairs, and fusion has made none; "
            "switch them off (null), or take nearest neighbours throughout (pair_target: nearest, nearest_from: 0.0)"
        )
    if config.repel.render and "art" not in losses:
        raise UserError(
            "phases.articulation.repel.render: draws the force of losses.art, which is switched off; expected "
            "render: false"
        )


@register_phase("articulation")
class ArticulationPhase(ImagePhase):
    """L = L_render + l_part L_part + l_art L_art + l_phys (L_contact + L_velocity + L_vector), over both states."""

    Config = ArticulationConfig
    needs = ("states", "canonical")
    uses = ("sharpened", "motions")
    gives = "learned"

    times: Tensor
    repel_points: Tensor
    knn_index: Tensor
    spacing: Tensor

    @classmethod
    def build(cls, run: RunContext, section, *, states, canonical, sharpened=None, motions=None) -> "ArticulationPhase":
        if motions is None and section.config.init == "discovery":
            raise UserError(
                "phases.articulation.init: discovery needs 'motions', which no stage hands over; add discovery to "
                "stages, "
                "or give --num_parts N and init: random or identity"
            )
        parts = len(motions) + 1 if motions is not None and not run.exact else run.num_parts
        states = sharpened or states
        return cls(
            section.config, section.losses, canonical, states, motions, parts, run.extent, run.views, **run.common()
        )

    def __init__(
        self,
        config: ArticulationConfig,
        losses: dict[str, Loss],
        canonical: CanonicalGaussians,
        states: list[StateGaussians],
        motions: PartMotions | None,
        num_parts: int,
        extent: float,
        views,
        **common,
    ):
        super().__init__(config, losses, views, **common)
        generator = self.generator(0, 3)
        self.states = [s.gaussians.means[s.gaussians.solid] for s in states]
        self.extent = extent
        check_losses(config, losses, canonical)
        labels = canonical.labels
        if config.init == "discovery":
            assert motions is not None  # ``build`` has seen to it
            labels, transforms = add_spare(
                labels, motions.transforms, num_parts - 1 - len(motions), self.generator(0, 6)
            )
            spare = len(transforms) - len(motions)
            self.types, self.confidence = (
                [*motions.types, *["free"] * spare],
                torch.cat([motions.confidence, torch.zeros(spare)]),
            )
        else:
            transforms = initial_screws(config.init, num_parts, generator)
            self.types, self.confidence = ["free"] * len(transforms), torch.zeros(len(transforms))
        parts = 1 + len(transforms)
        self.head = PartHead(config.embedding_dim, parts, generator)
        if config.init == "discovery" and config.psi == "init":
            sure = config.sureness * (
                0.25 + 0.75 * (canonical.margin / canonical.margin.median().clamp_min(1e-6)).clamp(0, 1)
            )
            psi = self.head.embed(labels, sure)
        else:
            psi = random_embeddings(len(canonical.gaussians), config.embedding_dim, generator)
        carried = {"paired": canonical.paired, "mu0": canonical.mu0, "mu1": canonical.mu1}
        self.splats = Splats(canonical.gaussians, extra={"psi": psi}, carried=carried)
        self._pairs: ObservedPairs | None = None
        self.screws = PartScrews(transforms)
        betas = torch.cat([canonical.betas, canonical.betas[:1].expand(max(parts - len(canonical.betas), 0))])
        self.register_buffer("times", (1.0 - betas).float().contiguous())
        self.register_buffer("repel_points", torch.zeros(0, 3))
        # the neighbourhood graph is state: a resumed run must use the one of the last refresh
        self.register_buffer("knn_index", torch.zeros(0, config.neighbours, dtype=torch.int64))
        self.register_buffer("spacing", torch.zeros(()))
        self.place_repel_points(0)

    # -- parameters ---------------------------------------------------------------------------------------------------
    def parameter_groups(self):
        rates = self.config.rates.at(0.0)
        groups = {name: ([getattr(self.splats, name)], rates[name]) for name in rates}
        groups["psi"] = ([self.splats.psi], self.config.rate_embedding)
        groups["classifier"] = (list(self.head.parameters()), self.config.rate_classifier)
        groups["screws"] = ([self.screws.xi], self.config.rate_screws)
        return groups

    def learning_rates(self, step: int) -> dict[str, float]:
        fraction = step / max(self.total_steps, 1)
        screws = (
            exponential(self.config.rate_screws, self.config.rate_screws_end, fraction)
            if fraction >= self.config.screws_from
            else 0.0
        )
        return {**self.config.rates.at(fraction), "screws": screws}

    def temperature(self, step: int) -> float:
        fraction = step / max(self.total_steps * self.config.harden_until, 1e-9)
        return exponential(self.config.temperature, self.config.temperature_end, fraction)

    # -- one step -----------------------------------------------------------------------------------------------------
    def inputs(self, visit: Visit) -> LossInputs:
        step, state = visit.step, visit.state
        camera, target = self.target(visit)
        g = self.splats.tensors()
        probs = self.head(self.splats.psi, self.temperature(step))
        moved = blend_move(g, probs, self.screws.twists(state - self.times))
        if self.config.repel.render:
            moved = moved.placed(moved.means + (1 - probs[:, :1]) * self.repel_force(moved.means, step), moved.quats)
        render = self.render(moved, camera, target.background)
        self.refresh(step, g, probs)
        parts = self.part_state(g, probs) if self.needed("parts") else None
        return LossInputs(step, self.total_steps, g, render, target, camera, parts, self.loss_cache)

    def repel_force(self, points: Tensor, step: int) -> Tensor:
        """The force of the loss ``art`` at points [N, 3] of any state (the repel points lie on the base, which does not
        move)."""
        art: Any = self.losses["art"]
        return art.force(points, self.repel_points, self.extent, art.tau(self.extent, step, self.total_steps))

    def refresh(self, step: int, g: GaussianTensors, probs: Tensor) -> None:
        """Renew neighbours and observed pairs every ``refresh`` steps."""
        if step % self.config.refresh and len(self.knn_index) == len(g):
            return
        distance, self.knn_index = knn(g.means.detach(), None, min(self.config.neighbours, len(g) - 1), True)
        self.spacing = distance[:, 0].median()
        if self.config.pair_target == "nearest" and step >= self.config.nearest_from * self.total_steps:
            self.renew_pairs(g, probs.detach())

    def part_state(self, g: GaussianTensors, probs: Tensor) -> PartState:
        """The losses' view of this step."""
        observed = (self.splats.paired, self.splats.mu0, self.splats.mu1)
        if self._pairs is None or not self._pairs.are_of(*observed):
            self._pairs = ObservedPairs(*observed)
        pairs, target_rotation = self._pairs, None
        if self.needed("rotations") and pairs.index.numel() >= 3:
            target_rotation = pairs.rotations(probs)
        hardness = (self.config.temperature - self.temperature(self.step)) / max(
            self.config.temperature - self.config.temperature_end, 1e-9
        )
        uniform = bool((self.times == self.times[0]).all())
        return PartState(
            probs=probs,
            means_canonical=g.means,
            transforms=self.screws.transforms(),
            canonical_time=float(self.times[0]) if uniform else self.times,
            extent=self.extent,
            spacing=float(self.spacing),
            pairs=pairs.index,
            mu0=pairs.mu0,
            mu1=pairs.mu1,
            knn=self.knn_index,
            target_rotation=target_rotation,
            repel_points=self.repel_points if len(self.repel_points) else None,
            hardness=hardness,
            twists=self.screws.xi,
        )

    @torch.no_grad()
    def renew_pairs(self, g: GaussianTensors, probs: Tensor) -> None:
        """Observed centres anew: nearest solid Gaussian of each single-state reconstruction to where the twin stands
        now."""
        labels = probs.argmax(1)
        device = g.means.device
        found, near = [], torch.ones(len(g), dtype=torch.bool, device=device)
        for state, points in enumerate(self.states):
            points = points.to(device)
            at = carry(g.detach(), labels, self.screws.at(state - self.times)).means
            distance, index = knn(points, at, 1, False)
            found.append(points[index[:, 0]])
            near &= distance[:, 0] <= 3 * distance[:, 0].median()
        self.splats.mu0, self.splats.mu1, self.splats.paired = found[0].contiguous(), found[1].contiguous(), near

    @torch.no_grad()
    def place_repel_points(self, step: int) -> None:
        """Sample repel points on the static base where movable parts are near (state 0)."""
        g = self.splats.tensors().detach()
        labels = self.head(self.splats.psi).argmax(1)
        at = carry(g, labels, self.screws.at(0.0 - self.times)).means
        static, movable = at[labels == 0], at[labels > 0]
        r = self.config.repel
        self.repel_points = at.new_zeros(0, 3)
        noise = r.noise * self.extent if step == 0 else 0.0
        if r.count > 0 and min(len(static), len(movable)) > 0:
            self.repel_points = place_repel_points(
                static,
                movable,
                r.count,
                r.threshold,
                r.threshold_mode,
                noise,
                self.generator(step, 4),
                extent=self.extent,
            )

    def on_load_checkpoint(self, checkpoint) -> None:
        for name in ("repel_points", "knn_index"):
            setattr(self, name, torch.empty_like(checkpoint["state_dict"][name]))

    # -- results ------------------------------------------------------------------------------------------------------
    @torch.no_grad()
    def hand_over(self) -> Articulation:
        """Argmax labels; parts with a canonical time of their own are carried to the common one."""
        probs = self.head(self.splats.psi, self.config.temperature_end).detach()
        time = float(self.times[0])
        g = carry(self.splats.tensors().detach(), probs.argmax(1), self.screws.at(time - self.times))
        return Articulation(g.clone(), probs, self.types, self.screws.transforms()[1:].double(), self.confidence, time)

    @torch.no_grad()
    def preview(self, times: list[float]) -> dict[str, Tensor]:
        from p2gs.ops.palette import part_colours

        g = self.splats.tensors().detach()
        labels = self.head(self.splats.psi).argmax(1)
        shot = self.picture(0)
        device = shot.image.device
        colours = part_colours(int(labels.max()) + 1).to(device)[labels]
        strips = {"rgb": [], "parts": []}
        for t in times:
            posed = carry(g, labels, self.screws.at(t - self.times))
            out = render_gaussians(
                posed, shot.camera, torch.ones(3, device=device), features=colours, backend=self.rasterizer
            )
            assert out.features is not None
            painted = out.features + (1 - out.alpha[..., None])
            strips["rgb"].append(out.colour)
            strips["parts"].append(painted)
        return {f"articulation_{n}": (torch.cat(s, dim=1).clamp(0, 1) * 255).to(torch.uint8) for n, s in strips.items()}

    @torch.no_grad()
    def summary(self) -> dict[str, float]:
        mass = self.head(self.splats.psi).mean(0)
        screw = se3.screw_parameters(self.screws.transforms()[1:].double())
        values = {f"part_mass/{k}": float(m) for k, m in enumerate(mass)}
        for k in range(len(self.types)):
            values[f"joint_{k + 1}/degrees"] = float(screw.angle[k]) * 57.29578
            values[f"joint_{k + 1}/slide"] = float(screw.translation[k])
        return values
