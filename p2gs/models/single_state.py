"""Reconstruct one joint state: 3D Gaussian splatting (paper section 3; Kerbl et al. 2023, DOI 10.1145/3592433) in CPU
minutes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from p2gs.context import RunContext
from p2gs.data.base import Visit
from p2gs.data.views import TrainingViews
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import StateGaussians
from p2gs.gaussians.splats import Splats
from p2gs.losses.base import Loss, LossInputs, Target
from p2gs.models.health import check_gaussians
from p2gs.models.initial import initial_points, isotropic_gaussians
from p2gs.models.mask_fit import edge_distances, growths_of, try_masks
from p2gs.models.phase import Phase, PhaseConfig, register_phase
from p2gs.models.registered import correct_scene
from p2gs.models.trial import Trial
from p2gs.models.view_fit import ViewErrors, ViewFitConfig, measure_gains, try_cameras, try_gains
from p2gs.ops.decay import exponential
from p2gs.types import Camera, GaussianTensors, RenderOutput, TwoStateScene
from p2gs.visibility.share import visible_share


@dataclass
class ImageConfig(PhaseConfig):
    """Options of every phase that renders views.

    levels: image sizes in pixels (long edge), coarse to fine; level_starts: fraction of the phase at which each begins.
    An image smaller than a level is used as it is. background: colour behind the object while training ("random"
    changes every step).
    """

    levels: list[int] = field(default_factory=lambda: [100, 200, 400])
    level_starts: list[float] = field(default_factory=lambda: [0.0, 0.1, 0.35])
    background: Literal["random", "white", "black", "grey"] = "random"


@dataclass
class SplatRates:
    """Learning rates of Gaussian parameters (internal units: the object's box has a diagonal of 2).

    Means decay geometrically to ``means_end``; the others to a tenth over the last 30 % of the phase.
    """

    means: float = 4e-4
    means_end: float = 4e-6
    log_scales: float = 5e-3
    opacity_logits: float = 5e-2
    quats: float = 2e-3
    sh0: float = 5e-3
    sh_rest: float = 5e-4

    def at(self, fraction: float) -> dict[str, float]:
        tail = exponential(1.0, 0.1, (fraction - 0.7) / 0.3)
        rates = {n: getattr(self, n) * tail for n in ("log_scales", "opacity_logits", "quats", "sh0", "sh_rest")}
        return {"means": exponential(self.means, self.means_end, fraction), **rates}


@dataclass
class SingleStateConfig(ImageConfig):
    """Options of the single-state phase.

    steps: paper 30,000. initial_gaussians: how many where there is no depth; depth_gaussians: where there is.
    sh_degree: 0-3. sh_every: steps until the next degree is switched on. init: "auto" starts on depth points where the
    scene has depth, "agreed" elsewhere on points on which its photographs agree, else, and with "random", anywhere in
    the silhouettes. initial_opacity: of random points, low, so that concavities stay open until the images fill them;
    depth_opacity: of points on surfaces. min_visible: Gaussians of which no training view sees this share are left out
    at the end: nothing formed them (0 = keep all). forgive: errors of single photographs.
    """

    steps: int = 6000
    initial_gaussians: int = 10000
    initial_opacity: float = 0.1
    depth_gaussians: int = 10000
    depth_opacity: float = 0.1
    init: Literal["auto", "agreed", "random"] = "auto"
    sh_degree: int = 1
    sh_every: int = 500
    min_visible: float = 0.1
    forgive: ViewFitConfig = field(default_factory=ViewFitConfig)
    rates: SplatRates = field(default_factory=SplatRates)


class ImagePhase(Phase):
    """A phase that renders training views of one or both states."""

    def __init__(self, config: ImageConfig, losses: dict[str, Loss], views: dict[int, TrainingViews], **common):
        super().__init__(config, losses, **common)
        self.views = views
        self.measured = any(v.has_depth for v in views.values())

    def level(self, step: int) -> int:
        """Image size (long edge) at a step."""
        fraction = step / max(self.total_steps, 1)
        level = self.config.levels[0]
        for size, start in zip(self.config.levels, self.config.level_starts, strict=False):
            if fraction >= start:
                level = size
        return level

    def background(self, step: int) -> Tensor:
        """[3], by the config."""
        if self.config.background == "random":
            return torch.rand(3, generator=self.generator(step, 1))
        return torch.full((3,), {"white": 1.0, "black": 0.0, "grey": 0.5}[self.config.background])

    def target(self, visit: Visit) -> tuple[Camera, Target]:
        """The photograph of this step: its camera and what the render is held against."""
        views, step = self.views[visit.state], visit.step // len(self.views)
        background = self.background(step)
        picked = views.get(visit.view, views.levels.index(self.level(step)), background)
        # the same view recurs with other backgrounds: statistics of the target may be cached only where it does not
        # change
        key = picked.key if self.config.background != "random" else None
        device = self.splats.means.device
        depth = None if picked.depth is None else picked.depth.to(device)
        return picked.camera.to(device), Target(
            picked.image.to(device), picked.alpha.to(device), background.to(device), depth, key, picked.key
        )

    def picture(self, state: int):
        """The first training view of a state on white, at the finest level: what previews show."""
        views = self.views[state]
        shot = views.get(0, views.levels.index(self.config.levels[-1]), torch.ones(3))
        device = self.splats.means.device
        return dataclasses.replace(shot, image=shot.image.to(device), camera=shot.camera.to(device))

    def render(
        self, g: GaussianTensors, camera: Camera, background: Tensor, sh_degree: int | None = None
    ) -> RenderOutput:
        return render_gaussians(
            g,
            camera,
            background,
            sh_degree=sh_degree,
            depth_sq=self.needed("depth_sq"),
            planes=self.measured and self.needed("planes"),
            absgrad=self.track_gradients,
            backend=self.rasterizer,
        )


class StatePhase(ImagePhase):
    """A phase of one state's Gaussians and photographs, with the config's ``rates``. Runs once for each state."""

    picture_name = "state"

    def __init__(self, config: ImageConfig, losses: dict[str, Loss], state: int, views: TrainingViews, **common):
        super().__init__(config, losses, {state: views}, **common)
        self.state = state
        self.seed = self.seed * 2 + state

    def parameter_groups(self):
        rates = self.config.rates.at(0.0)
        return {name: ([getattr(self.splats, name)], rates[name]) for name in rates}

    def learning_rates(self, step: int) -> dict[str, float]:
        return self.config.rates.at(step / max(self.total_steps, 1))

    @torch.no_grad()
    def preview(self, times: list[float]) -> dict[str, Tensor]:
        shot = self.picture(self.state)
        white = torch.ones(3, device=shot.image.device)
        out = render_gaussians(self.splats.tensors(), shot.camera, white, backend=self.rasterizer)
        both = torch.cat([shot.image, out.colour], dim=1)
        return {f"{self.picture_name}_{self.state}": (both.clamp(0, 1) * 255).to(torch.uint8)}


@register_phase("single_state")
class SingleStatePhase(StatePhase):
    """3DGS of one state: L_render (paper Eq. 4) plus the losses the config names."""

    Config = SingleStateConfig
    gives = "states"
    each_state = True
    num_parts_matters = False
    changes_scene = True

    @classmethod
    def build(cls, run: RunContext, section, *, state: int) -> "SingleStatePhase":
        options = {"seed": run.seed, "rasterizer": run.rasterizer}
        return cls(section.config, section.losses, run.scene, state, run.views_of(state), **options)

    @classmethod
    def hand_on(cls, run: RunContext, value: list[StateGaussians]) -> dict:
        """Cameras and exposures of training photographs are from here on as the states found them."""
        run.take(correct_scene(run.scene_as_read, value))
        return {cls.gives: value}

    def __init__(
        self,
        config: SingleStateConfig,
        losses: dict[str, Loss],
        scene: TwoStateScene,
        state: int,
        views: TrainingViews,
        **common,
    ):
        super().__init__(config, losses, state, views, **common)
        counts = (config.initial_gaussians, config.depth_gaussians)
        start = initial_points(scene, state, counts, config.init, self.generator(0, 2))
        opacity = torch.where(start.known, config.depth_opacity, config.initial_opacity)
        self.splats = Splats(isotropic_gaussians(start.points, start.colours, opacity, config.sh_degree))
        self.shots = scene.select(state=state, split="train")
        self.errors, self.put_right = ViewErrors(len(self.shots)), None

    def inputs(self, visit: Visit) -> LossInputs:
        step = visit.step
        self.forgive(step)
        camera, target = self.target(visit)
        camera = self.errors.camera(visit.view, camera)
        g = self.splats.tensors()
        degree = min(self.config.sh_degree, step // max(self.config.sh_every, 1))
        render = self.render(g, camera, target.background, degree)
        return LossInputs(step, self.total_steps, g, render, target, camera, cache=self.loss_cache)

    def constrain_gradients(self) -> None:
        config = self.config.forgive
        fraction = (self.step / max(self.total_steps, 1) - config.at) / max(1 - config.at, 1e-9)
        self.errors.learn(config.rate * exponential(1.0, 0.01, fraction))

    def forgive(self, step: int) -> None:
        """At their steps: decide which errors are looked for, cameras first, for a gain is told by pixels that lie on
        one another; measure gains and masks; photographs lose what is known of both; then all cameras."""
        config, errors, size = self.config.forgive, self.errors, self.level(step)
        g, views = self.splats.tensors().detach(), self.views[self.state]
        first, *later = [round(share * self.total_steps) for share in (config.at, *config.measured)]
        bundled = [round(share * self.total_steps) for share in config.bundled]
        if step == first and config.cameras == "auto":
            self.decide(1, "cameras", try_cameras(g, views, size, self.rasterizer))
        if step in later and config.gains == "auto":
            if not bool(errors.decided[0]):
                self.decide(0, "gains", try_gains(g, views, errors, size, self.rasterizer))
            if bool(errors.on[0]):
                errors.log_gains += measure_gains(g, views, errors, size, self.rasterizer)
        if step in bundled and config.masks == "auto" and (bool(errors.on[2]) or not bool(errors.decided[2])):
            self.measure_masks(size)
        known = torch.cat([errors.log_gains, errors.growths[:, None]], 1).cpu()
        if bool(known.any()) and (self.put_right is None or not torch.equal(known, self.put_right)):
            self.views[self.state] = TrainingViews(errors.views(self.shots), views.levels)
            self.put_right = known
        if step in bundled and bool(errors.on[1]):
            errors.adjust(g, self.views[self.state], size, self.rasterizer)

    def measure_masks(self, size: int) -> None:
        """How wide masks are by pictures of ``size`` pixels; the first time, whether that is looked for."""
        g, errors = self.splats.tensors().detach(), self.errors
        shots = errors.shots(self.views[self.state], size, g.means.device)
        edges = [edge_distances(g, shot, self.rasterizer) for shot in shots]
        if not bool(errors.decided[2]):
            self.decide(2, "masks", try_masks(edges))
        if bool(errors.on[2]):
            errors.growths += growths_of(edges).to(errors.growths)

    def decide(self, which: int, name: str, found: Trial) -> None:
        """Switch gains (0), cameras (1) or masks (2) on where held-out halves say so, and tell."""
        self.errors.decided[which] = True
        forgive = self.config.forgive
        self.errors.on[which] = found.passed((forgive.least, forgive.least_cameras, forgive.least)[which])
        outcome = "on" if self.errors.on[which] else "off"
        print(f"{self.phase_name}: {name} of single photographs: {found.told()}: {outcome}", flush=True)

    def hand_over(self) -> StateGaussians:
        g, views, corrections = self.splats.tensors().clone(), self.views[self.state], self.errors.handed_over()
        if self.config.min_visible > 0 and len(g):
            cameras = [views.camera(i, views.levels.index(self.config.levels[-1])) for i in range(len(views))]
            g = g[visible_share(g, cameras, self.rasterizer) >= self.config.min_visible]
        check_gaussians(self.phase_name, len(g), len(self.splats))
        return StateGaussians(self.state, g, corrections)
