"""Masks from 3D: the object's Gaussians of a coarse splat drawn into every photograph, their edge sharpened in the
photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from p2gs.data.capture.coarse import Picture, Region, Splat, fit, initial, object_rows, region_of
from p2gs.data.capture.hull import Hull, hull_of
from p2gs.data.capture.joint import is_end, states_of
from p2gs.data.capture.model import Model
from p2gs.data.capture.segmenters import AROUND, Segmenter, frame_of
from p2gs.data.capture.write import pinhole_of
from p2gs.data.exposure import corrected
from p2gs.types import Camera, UserError

COARSE = 200  # px, long edge of the splat's pictures
SHARP = 480  # px, long edge that edges are sharpened at
BAND = 0.012  # of the long edge, to either side of the drawn edge: two pixels of the splat's pictures
PORE = 0.03  # of the mask: smaller holes are the coarse splat's, where a plain side gave it nothing to hold on to
CHANGED = 0.15  # share of the mask that sharpening may change before it is not believed
ALIKE = 0.5  # intersection over union of a model's mask with what the splat shows, below which it means something else


Window = tuple[slice, slice]  # rows and columns of an undistorted photograph


def pictures_of(
    model: Model, photos: Path, gains: dict[int, np.ndarray], windows: dict[int, Window], size: int
) -> list[Picture]:
    """The ``windows`` of photographs undistorted, their gains taken out, at a long edge of ``size``."""
    import cv2

    out = []
    for key, window in windows.items():
        photo = model.photos[key]
        lens = model.lenses[photo.lens]
        pinhole = pinhole_of(lens)
        image = corrected(cv2.imread(str(photos / photo.name))[..., ::-1], gains.get(key, np.zeros(3)))
        image = cv2.remap(image, *pinhole.maps, cv2.INTER_LINEAR)[window]
        (height, width), (y, x) = image.shape[:2], (side.start for side in window)
        camera = Camera(torch.tensor(photo.viewmat).float(), torch.tensor(pinhole.K).float(), lens.width, lens.height)
        camera, factor = camera.cropped(x, y, width, height), min(1.0, size / max(width, height))
        width, height = round(width * factor), round(height * factor)
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        out.append(Picture(camera.scaled(width, height), torch.from_numpy(image).float() / 255))
    return out


def band(shape: tuple[int, ...]) -> int:
    """Pixels to either side of a drawn edge within which the true one lies, in a picture of ``shape``."""
    return max(round(BAND * max(shape)), 2)


def sharpened(image: np.ndarray, share: np.ndarray) -> np.ndarray:
    """[h, w] bool: the object by GrabCut in a band around the edge of ``share`` [h, w] float (what the splat says);
    what is thinner than the band stays as drawn, for nothing in it is sure. image: uint8 RGB."""
    import cv2

    drawn = (share > 0.5).astype(np.uint8)
    reach = band(drawn.shape)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    inner, outer = cv2.erode(drawn, kernel), cv2.dilate(drawn, kernel)
    if not inner.any() or outer.all():
        return drawn > 0
    labels = np.where(drawn > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[inner > 0], labels[outer == 0] = cv2.GC_FGD, cv2.GC_BGD
    cv2.setRNGSeed(0)
    cv2.grabCut(
        np.ascontiguousarray(image[..., ::-1]),
        labels,
        None,
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        3,
        cv2.GC_INIT_WITH_MASK,
    )
    cut = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD) | (drawn > cv2.dilate(inner, kernel))
    return drawn > 0 if (cut != (drawn > 0)).sum() > CHANGED * drawn.sum() else cut


def without_pores(mask: np.ndarray) -> np.ndarray:
    """The mask [h, w] bool with enclosed holes below ``PORE`` of its area filled."""
    from scipy.ndimage import binary_fill_holes, label

    holes, count = label(binary_fill_holes(mask) & ~mask)
    sizes = np.bincount(holes.ravel(), minlength=count + 1)
    small = sizes < PORE * mask.sum()
    small[0] = False
    return mask | small[holes]


def shares(splat: Splat, rows: torch.Tensor, camera: Camera) -> np.ndarray:
    """[h, w] how much of each pixel Gaussians ``rows`` [N] bool show: what is neither floor nor wall."""
    with torch.no_grad():
        return splat.render(camera, features=rows[:, None].float()).features[..., 0].numpy()


def object_in(
    splat: Splat, rows: torch.Tensor, hull: Hull, coarse: Camera, sharp: Picture, segmenter: Segmenter | None = None
) -> tuple[np.ndarray, bool]:
    """[h, w] bool: the object in ``sharp``: what the splat shows within the hull, its edge sharpened or drawn by the
    segmenter; and whether that was believed. coarse: the photograph's camera at the size that the hull was made by."""
    import cv2

    share = shares(splat, rows, sharp.camera)
    outline = cv2.resize(hull.outline(coarse).astype(np.float32), share.shape[::-1], interpolation=cv2.INTER_LINEAR)
    image, share = (255 * sharp.image.numpy()).astype(np.uint8), np.where(outline > 0.5, share, 0.0)
    if segmenter is None or not (share > 0.5).any():
        return sharpened(image, share), True
    found = segmented(segmenter, image, share, outline > 0.5)
    return (sharpened(image, share), False) if found is None else (found, True)


def segmented(segmenter: Segmenter, image: np.ndarray, share: np.ndarray, outline: np.ndarray) -> np.ndarray | None:
    """[h, w] bool: the object by a model, within the hull's ``outline`` [h, w] and a band around it; None where it is
    another thing than the splat's ``share`` [h, w] shows."""
    import cv2

    drawn = share > 0.5
    reach = band(drawn.shape)
    within = cv2.dilate(outline.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
    found = segmenter(image, drawn) & within
    return found if (found & drawn).sum() >= ALIKE * (found | drawn).sum() else None


def state_masks(
    model: Model,
    photos: Path,
    gains: dict,
    region: Region,
    end: bool,
    segmenter: Segmenter | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, np.ndarray]:
    """Masks [H, W] uint8 in the copies' (distorted) pixels of one state's photographs, by name."""
    state = "end" if end else "start"
    lenses = {k: model.lenses[p.lens] for k, p in model.photos.items() if is_end(p.name) == end}
    windows: dict[int, Window] = {k: (slice(0, lens.height), slice(0, lens.width)) for k, lens in lenses.items()}
    look = partial(_look, model, photos, gains, end)
    seen = look(region, windows)
    if len(seen.hull.points) == 0:
        raise UserError(f"the object could not be told from the room in state '{state}'; give --masks DIR")
    near, windows = nearer(region, seen, lenses)
    closer = look(near, windows) if windows else seen
    seen = closer if len(closer.hull.points) else seen
    out, others = {}, 0
    for (key, coarse), sharp in zip(
        seen.cameras.items(), pictures_of(model, photos, gains, seen.windows, SHARP), strict=True
    ):
        found, believed = object_in(seen.splat, seen.rows, seen.hull, coarse, sharp, segmenter)
        mask, others = without_pores(found), others + (not believed)
        whole = distorted(mask, lenses[key], seen.windows[key])
        if whole.any():
            out[model.photos[key].name] = whole
    if others:
        progress(f"{state}: in {others} photographs the model found another thing; there the edge is GrabCut's")
    return out


@dataclass(frozen=True)
class Look:
    """A coarse fit of a state: by photograph the window that it saw and the camera of that; which of its Gaussians are
    the object [N], and the hull of these."""

    windows: dict[int, Window]
    cameras: dict[int, Camera]
    splat: Splat
    rows: torch.Tensor
    hull: Hull


def _look(
    model: Model, photos: Path, gains: dict[int, np.ndarray], end: bool, region: Region, windows: dict[int, Window]
) -> Look:
    mine = states_of(model)[:, int(end)]
    splat = initial(region, model.xyz[mine], model.rgb[mine])
    pictures = pictures_of(model, photos, gains, windows, COARSE)
    fit(splat, pictures, region.fine)
    rows = object_rows(splat, region)
    hull = hull_of(region, [(p.camera, shares(splat, rows, p.camera) > 0.5) for p in pictures])
    return Look(windows, dict(zip(windows, (p.camera for p in pictures), strict=True)), splat, rows, hull)


def nearer(region: Region, seen: Look, lenses: dict) -> tuple[Region, dict[int, Window]]:
    """The hull's box, and the windows of the photographs about it, for another look in which the object fills the
    pictures: a table's legs are a pixel wide in the first."""
    points, windows, shares_ = seen.hull.points, {}, []
    for key, camera in seen.cameras.items():
        outline = seen.hull.outline(camera)
        if outline.any():
            rows, columns = frame_of(outline, AROUND)
            factor = lenses[key].width / camera.width
            ends = [[int(x.start * factor), int(np.ceil(x.stop * factor))] for x in (rows, columns)]
            high = min(ends[0][1], lenses[key].height), min(ends[1][1], lenses[key].width)
            windows[key] = (slice(ends[0][0], high[0]), slice(ends[1][0], high[1]))
            shares_.append(max(high[0] - ends[0][0], high[1] - ends[1][0]) / max(lenses[key].width, lenses[key].height))
    margin = AROUND * (points.max(0) - points.min(0)).max()
    box = np.stack([points.min(0) - margin, points.max(0) + margin])
    if region.box is not None:
        box = np.stack([np.maximum(box[0], region.box[0]), np.minimum(box[1], region.box[1])])
    return replace(region, box=box, share=float(np.median(shares_)) if shares_ else 1.0), windows


def distorted(mask: np.ndarray, lens, window: Window | None = None) -> np.ndarray:
    """An undistorted mask [h, w] bool of any size, of a ``window`` (None: of all), brought into the lens's own picture,
    [H, W] uint8."""
    import cv2

    down, across = window or (slice(0, lens.height), slice(0, lens.width))
    K, x, y, factor = pinhole_of(lens).K, across.start, down.start, mask.shape[1] / (across.stop - across.start)
    across, down = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.rays(np.stack([across.ravel(), down.ravel()], 1)).reshape(lens.height, lens.width, 2)
    u = (rays[..., 0] * K[0, 0] + K[0, 2] - x) * factor - 0.5
    v = (rays[..., 1] * K[1, 1] + K[1, 2] - y) * factor - 0.5
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.0)
    return np.where(cv2.remap(soft, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR) > 0.5, 255, 0).astype(
        np.uint8
    )


def auto_masks(
    model: Model,
    photos: Path,
    gains: dict,
    progress: Callable[[str], None] = lambda text: None,
    box: np.ndarray | None = None,
    segmenter: Segmenter | None = None,
) -> dict[str, np.ndarray]:
    """Masks of both states by photograph's name. model: z up, floor at 0.  box: [2, 3] within which the object is in
    both states (None: what the cameras look at).  segmenter: draws edges (None: GrabCut does)."""
    centre, distance = model.centre()
    centre = np.array([*centre[:2], max(centre[2], 0.1 * distance)]) if box is None else box.mean(0)
    cameras = np.array([p.position for p in model.photos.values()])
    region = replace(region_of(model.xyz, cameras, centre, distance), box=box)
    progress(f"masks: a coarse fit of each state ({len(region.planes) - 1} walls)")
    both = [state_masks(model, photos, gains, region, end, segmenter, progress) for end in (False, True)]
    return both[0] | both[1]
