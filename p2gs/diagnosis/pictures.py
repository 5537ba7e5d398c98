"""Pictures of every stage's own measure, from photographs and hand-over objects (internal coordinates); strips for the
diagnosis page."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from p2gs.data.views import TargetImage, TrainingViews
from p2gs.diagnosis.measures import STATES, StageResults, evidence_points
from p2gs.export.pages.media import beside, captioned, fit
from p2gs.gaussians.handover import StateGaussians
from p2gs.gaussians.paint import draw, part_coloured, to_image
from p2gs.gaussians.pose import pose
from p2gs.models.finish_record import FinishRecord
from p2gs.motion.screw_polish import MovedGaussians
from p2gs.ops import se3
from p2gs.types import ArticulatedObject, Camera, GaussianTensors

CELL = 260  # pixels of a picture's longer side
WORST = 0.25  # mean |render - photo| that is drawn brightest
EVIDENCE = {1: (0.90, 0.15, 0.10), 0: (0.35, 0.55, 0.75), -1: (0.95, 0.80, 0.15)}  # moved, static, unknown
UNCLEAR = (0.85, 0.10, 0.75)


@torch.no_grad()
def diagnostic_strips(
    stages: StageResults,
    twin: ArticulatedObject,
    views: dict[int, TrainingViews],
    min_margin: float,
    backend: str = "auto",
) -> list[tuple[str, str, np.ndarray]]:
    """(stage, what the strip shows, uint8 picture [H, W, 3]), the start state above the end state. backend: draws the
    sharpened states."""
    states, motions, record = stages.found_in, stages.motions, stages.record
    shots = [chosen_shot(states, record, views, s) for s in (0, 1)]
    photos = [to_image(shot.image) for shot in shots]
    rows: dict[str, list] = {"state": [], "evidence": [], "moved": [], "twin": []}
    for s, (shot, photo) in enumerate(zip(shots, photos, strict=True)):
        name, g = STATES[s], states[s].gaussians
        own = draw(g, shot.camera).colour
        rows["state"].append(
            [(f"photograph ({name})", photo), ("reconstruction", to_image(own)), ("difference", heat(own, shot))]
        )
        cells = [("parts", to_image(draw(part_coloured(g, record.labels[s]), shot.camera).colour))]
        cells.append(
            ("unclear labels", marked(photo, g, shot.camera, (record.margin[s] < min_margin).long(), {1: UNCLEAR}))
        )
        if motions is not None:
            solid, seen = evidence_points(motions, states[s])
            if seen is not None:
                cells.insert(0, ("moved / static / unknown", marked(photo, g[solid], shot.camera, seen, EVIDENCE)))
        rows["evidence"].append(cells)
        arrived = moved_here(stages.states[1 - s], record, 1 - s, shot, backend)
        whence = f"{STATES[1 - s]} state moved here"
        rows["moved"].append(
            [(f"photograph ({name})", photo), (whence, to_image(arrived)), ("difference", heat(arrived, shot))]
        )
        posed = pose(twin, float(s))
        final = draw(posed, shot.camera).colour
        parts = to_image(draw(part_coloured(posed, twin.part_ids), shot.camera).colour)
        rows["twin"].append(
            [(f"twin ({name})", to_image(final)), ("its parts", parts), ("difference", heat(final, shot))]
        )
    told = {
        "state": (
            "single_state",
            "Each state against a photograph. Bright differences: the reconstruction itself is wrong there.",
        ),
        "evidence": (
            "discovery",
            "Red: seen through by the other state's cameras, so it moved; blue: still there; yellow: hidden, says "
            "nothing. Parts are what "
            "the last stage carried to this state; magenta: labels left out of the polish.",
        ),
        "moved": (
            "finish",
            "Each state's Gaussians carried into the other state by the joints found. A wrong joint or label is a "
            "bright region.",
        ),
        "twin": ("articulation", "The twin as it was learned and polished, posed in both states."),
    }
    return [(*told[key], strip(cells)) for key, cells in rows.items()]


def chosen_shot(states, record: FinishRecord, views: dict[int, TrainingViews], s: int, looks: int = 12) -> TargetImage:
    """The photograph of state ``s``, of ``looks`` spread over its views, in which most of every moving part shows; over
    white."""
    mine = views[s]
    coarse, fine = (
        min(range(len(mine.levels)), key=mine.levels.__getitem__),
        max(range(len(mine.levels)), key=mine.levels.__getitem__),
    )
    moving, parts = record.labels[s] > 0, len(record.after)
    picked = mine.spread(looks)
    best, index = -1.0, picked[0]
    if bool(moving.any()):
        onehot = torch.nn.functional.one_hot(record.labels[s], parts + 1).float()[:, 1:16].contiguous()
        for i in picked:
            share = draw(states[s].gaussians, mine.camera(i, coarse), features=onehot).painted.mean((0, 1)).sqrt().sum()
            if float(share) > best:
                best, index = float(share), i
    return mine.get(index, fine, torch.ones(3))


def moved_here(state: StateGaussians, record: FinishRecord, s: int, shot: TargetImage, backend: str) -> Tensor:
    """Colour [H, W, 3] of a state's Gaussians carried to the other state, over white."""
    body = MovedGaussians(state.gaussians, record.labels[s])
    means, quats, sh = body.moved(record.after if s == 0 else se3.inverse(record.after))
    return draw(
        GaussianTensors(means, quats, body.g.log_scales, body.g.opacity_logits, sh), shot.camera, backend=backend
    ).colour


def heat(colour: Tensor, shot: TargetImage) -> np.ndarray:
    """|render - photo| as a picture, uint8 [H, W, 3]: dark 0, brightest ``WORST``. render: [H, W, 3]."""
    import cv2

    error = (colour.clamp(0, 1) - shot.image).abs().mean(-1).div(WORST).clamp(0, 1)
    return cv2.applyColorMap((error * 255).round().to(torch.uint8).numpy(), cv2.COLORMAP_INFERNO)[..., ::-1]


def marked(
    photo: np.ndarray, g: GaussianTensors, camera: Camera, classes: Tensor, colours: dict[int, tuple]
) -> np.ndarray:
    """The photograph in grey with Gaussians of the named classes [N] in their colours; others only hide what is behind
    them."""
    paint = torch.zeros(len(g), 4)
    for value, colour in colours.items():
        paint[classes == value] = torch.tensor([*colour, 1.0])
    layer = draw(g, camera, features=paint).painted.numpy()
    grey = np.repeat(photo.mean(-1, keepdims=True), 3, -1) / 255 * 0.6 + 0.4
    out = grey * (1 - 0.75 * layer[..., 3:]) + 0.75 * layer[..., :3]
    return (out.clip(0, 1) * 255).round().astype(np.uint8)


def strip(rows: list[list[tuple[str, np.ndarray]]]) -> np.ndarray:
    """Captioned pictures, uint8 [h, w, 3] each, in rows and columns: one [H, W, 3]."""
    columns = max(map(len, rows))
    blank = ("", np.full((CELL, CELL, 3), 255, np.uint8))
    lines = [
        beside([captioned(fit(p, CELL, CELL), text) for text, p in row + [blank] * (columns - len(row))])
        for row in rows
    ]
    return np.concatenate(lines)
