"""Corrections applied: to Gaussians, to photographs with their cameras, and kept in the result folder."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Iterable

import torch
from torch import Tensor

from p2gs.data.exposure import brightened, corrected
from p2gs.gaussians.handover import Registration, StateGaussians, ViewCorrections
from p2gs.models.mask_fit import regrown
from p2gs.ops import se3
from p2gs.ops.carry import Parts, carry
from p2gs.ops.sh import dc_to_rgb, rgb_to_dc
from p2gs.types import GaussianTensors, TwoStateScene, View

REGISTRATION = "registration.json"  # in the result folder


def dimmed(g: GaussianTensors, log_gain: Tensor) -> GaussianTensors:
    """The same Gaussians exp(log_gain [3]) times as bright in linear light."""
    if not bool(log_gain.any()):
        return g
    base = dc_to_rgb(g.sh[:, 0])
    shown = base.clamp(1e-3, 1)  # what lies outside is scaled as the nearest colour is
    factor = brightened(shown, log_gain) / shown
    return replace(g, sh=torch.cat([rgb_to_dc(base * factor)[:, None], g.sh[:, 1:] * factor[:, None]], 1))


def register_state(state: StateGaussians, found: Registration) -> StateGaussians:
    """The end state in the start's frame, as bright as the start; the start itself as it is."""
    if state.state == 0 or found.is_identity:
        return state
    g = dimmed(state.gaussians, -found.log_gain)
    labels = torch.ones(len(g), dtype=torch.long, device=g.means.device)
    means, quats, sh = carry(
        g.means, g.quats, g.sh.contiguous(), Parts(labels), found.transform[None].to(g.means.device)
    )
    return replace(state, gaussians=GaussianTensors(means, quats, g.log_scales, g.opacity_logits, sh))


def register_views(scene: TwoStateScene, found: Registration) -> TwoStateScene:
    """The scene with the end's cameras, of all splits, in the start's frame, and its photographs as bright as the
    start's."""
    if found.is_identity:
        return scene
    back = se3.inverse(found.transform)
    return scene.with_views(v if v.state == 0 else correct_view(v, back, found.log_gain) for v in scene.views)


def correct_view(view: View, motion: Tensor, log_gain: Tensor, growth: float = 0.0) -> View:
    """A photograph whose camera V becomes V motion [4, 4], that loses ``log_gain`` [3] and whose mask gets narrower by
    ``growth`` (``regrown``)."""
    view = regrown(view, growth)
    viewmat = (view.camera.viewmat.double() @ motion).float()
    image = view.image
    if bool(log_gain.any()):
        image = torch.from_numpy(corrected(image.numpy(), log_gain.numpy()))
    return replace(view, camera=replace(view.camera, viewmat=viewmat), image=image)


def correct_views(views: Iterable[View], corrections: ViewCorrections | None) -> list[View]:
    """A state's training photographs, in the scene's order, with cameras and exposure put right."""
    views = list(views)
    if corrections is None:
        return views
    rows = zip(corrections.motions, corrections.log_gains, corrections.growths.tolist(), strict=True)
    return [correct_view(v, *row) for v, row in zip(views, rows, strict=True)]


def correct_scene(scene: TwoStateScene, states: list[StateGaussians]) -> TwoStateScene:
    """The scene with the training photographs as the single states found them to be; the scene itself where they found
    no error."""
    if all(s.corrections is None for s in states):
        return scene
    found = {s.state: iter(correct_views(scene.select(s.state, "train"), s.corrections)) for s in states}
    return scene.with_views(next(found[v.state]) if v.split == "train" else v for v in scene.views)


def write_registration(path: Path, found: Registration, states: list[StateGaussians], scene: TwoStateScene) -> None:
    """RUN/registration.json, in input coordinates: what was applied to the photographs and what was measured.  scene:
    as it was read."""
    similarity, images = scene.similarity, []
    for s in states:
        if s.corrections is not None:
            c = s.corrections
            each = zip(c.motions, c.log_gains.tolist(), c.growths.tolist(), strict=True)
            for view, (motion, gain, growth) in zip(scene.select(s.state, "train"), each, strict=True):
                told = {"motion": similarity.transform_to_input(motion).tolist(), "log_gain": gain, "growth": growth}
                images.append({"state": s.state, "name": view.name, **told})
    rows = {"transform": similarity.transform_to_input(found.transform).tolist(), "log_gain": found.log_gain.tolist()}
    path.write_text(
        json.dumps({"format": "p2gs-registration/1", **rows, "images": images, "figures": found.figures}, indent=1)
        + "\n"
    )


def read_registration(path: Path) -> tuple[Registration, dict[tuple[int, str], tuple[Tensor, Tensor, float]]]:
    """What ``write_registration`` kept: the end's, and motion [4, 4], gain [3] and growth of the mask by state and name
    of a photograph; nothing without a file."""
    if not path.is_file():
        return Registration(torch.eye(4, dtype=torch.float64), torch.zeros(3)), {}
    stored = json.loads(path.read_text())
    found = Registration(
        torch.tensor(stored["transform"], dtype=torch.float64), torch.tensor(stored["log_gain"]), stored["figures"]
    )
    images = {
        (i["state"], i["name"]): (
            torch.tensor(i["motion"], dtype=torch.float64),
            torch.tensor(i["log_gain"]),
            i.get("growth", 0.0),  # a file of an earlier build
        )
        for i in stored["images"]
    }
    return found, images


def as_fitted(scene: TwoStateScene, run_dir: Path | str) -> TwoStateScene:
    """A scene in input coordinates with the cameras and exposures that a run's fit gave its photographs."""
    found, images = read_registration(Path(run_dir) / REGISTRATION)
    views = (
        correct_view(v, *images[v.state, v.name]) if v.split == "train" and (v.state, v.name) in images else v
        for v in scene.views
    )
    return register_views(scene.with_views(views) if images else scene, found)
