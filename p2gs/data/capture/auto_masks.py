"""Masks from 3D: the object's Gaussians of a coarse splat drawn into every photograph, their edge sharpened in the
photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from p2gs.data.capture.coarse import Picture, Region, Splat, fit, initial, object_rows, region_of
from p2gs.data.capture.hull import Hull, hull_of
from p2gs.data.capture.joint import is_end, states_of
from p2gs.data.capture.model import Lens, Model
from p2gs.data.capture.segmenters import AROUND, Segmenter, frame_of
from p2gs.data.capture.write import pinhole_of
from p2gs.data.exposure import corrected
from p2gs.data.frames import STATES
from p2gs.types import Camera, UserError

COARSE = 200  # px, long edge of the splat's pictures
SHARP = 480  # px, long edge that edges are sharpened at
CELLS = 2  # of a hull by which its box is widened: three pixels of the pictures that it was made of
BAND = 0.012  # of the long edge, to either side of the drawn edge: two pixels of the splat's pictures
PORE = 0.03  # of the mask: smaller holes are the coarse splat's, where a plain side gave it nothing to hold on to
CHANGED = 0.15  # share of the mask that sharpening may change before it is not believed
ALIKE = 0.5  # intersection over union of a model's mask with what the splat shows, below which it means something else

Window = tuple[slice, slice]  # rows and columns of an undistorted photograph


def whole(lens: Lens) -> Window:
    """All of a lens's photographs."""
    return slice(0, lens.height), slice(0, lens.width)


def pictures_of(
    model: Model, photos: Path, gains: dict[int, np.ndarray], windows: dict[int, Window], size: int
) -> list[Picture]:
    """The ``windows`` of photographs undistorted, their gains taken out, at a long edge of ``size``."""
    import cv2

    out, pinholes = [], {key: pinhole_of(lens) for key, lens in model.lenses.items()}
    for key, window in windows.items():
        photo = model.photos[key]
        lens, pinhole = model.lenses[photo.lens], pinholes[photo.lens]
        image = corrected(cv2.imread(str(photos / photo.name))[..., ::-1], gains.get(key, np.zeros(3)))
        image = cv2.remap(image, *(of[window] for of in pinhole.maps), cv2.INTER_LINEAR)
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


@dataclass(frozen=True)
class Look:
    """A coarse fit of a state: by photograph the window that it saw and the camera of that; which of its Gaussians are
    the object [N], and the hull of these."""

    windows: dict[int, Window]
    cameras: dict[int, Camera]
    splat: Splat
    rows: torch.Tensor
    hull: Hull


def look(
    model: Model,
    photos: Path,
    gains: dict[int, np.ndarray],
    region: Region,
    windows: dict[int, Window],
    end: bool,
    before: Look | None = None,
) -> Look:
    """One state through ``windows`` of its photographs; those of the other are left out. before: an earlier look, which
    knows what is beside the region."""
    seen = states_of(model)
    mine = seen[:, int(end)] | ~seen.any(1)  # points that came with given poses are of both states
    windows = {key: window for key, window in windows.items() if is_end(model.photos[key].name) == end}
    splat = initial(region, model.xyz[mine], model.rgb[mine], before=None if before is None else before.splat)
    pictures = pictures_of(model, photos, gains, windows, COARSE)
    fit(splat, pictures, region.fine)
    rows = object_rows(splat, region)
    hull = hull_of(region, [(p.camera, shares(splat, rows, p.camera) > 0.5) for p in pictures])
    return Look(windows, dict(zip(windows, (p.camera for p in pictures), strict=True)), splat, rows, hull)


def nearer(region: Region, seen: list[Look], model: Model) -> tuple[Region, dict[int, Window]]:
    """The box of what was ``seen`` in both states, and the windows of the photographs about it, for another look in
    which the object fills the pictures: a table's legs are a pixel wide in the first. One box for both states: what it
    cuts off (the legs of a table that the object stands on) is cut alike and has not moved."""
    body = Hull(np.concatenate([of.hull.points for of in seen]), seen[0].hull.step)
    windows, longest = {}, []
    for key, camera in (seen[0].cameras | seen[1].cameras).items():
        outline, lens = body.outline(camera), model.lenses[model.photos[key].lens]
        if outline.any():
            factor = lens.width / camera.width
            windows[key] = tuple(
                slice(int(side.start * factor), min(int(np.ceil(side.stop * factor)), all_.stop))
                for side, all_ in zip(frame_of(outline, AROUND), whole(lens), strict=True)
            )
            longest.append(max(side.stop - side.start for side in windows[key]) / max(lens.width, lens.height))
    low, high = body.points.min(0), body.points.max(0)
    box = np.stack([low, high]) + CELLS * body.step * np.array([[-1.0], [1.0]])
    if region.box is not None:
        box = np.stack([np.maximum(box[0], region.box[0]), np.minimum(box[1], region.box[1])])
    return replace(region, box=box, share=float(np.median(longest))), windows


def masks_of(
    model: Model, photos: Path, gains: dict[int, np.ndarray], seen: Look, segmenter: Segmenter | None
) -> tuple[dict[str, np.ndarray], int]:
    """Masks [H, W] uint8 in the copies' (distorted) pixels of the photographs of a state, by name; and in how many the
    segmenter was not believed."""
    out, others = {}, 0
    sharp = pictures_of(model, photos, gains, seen.windows, SHARP)
    for (key, coarse), picture in zip(seen.cameras.items(), sharp, strict=True):
        photo = model.photos[key]
        found, believed = object_in(seen.splat, seen.rows, seen.hull, coarse, picture, segmenter)
        mask, others = without_pores(found), others + (not believed)
        placed = distorted(mask, model.lenses[photo.lens], seen.windows[key])
        if placed.any():
            out[photo.name] = placed
    return out, others


def distorted(mask: np.ndarray, lens, window: Window | None = None) -> np.ndarray:
    """An undistorted mask [h, w] bool of any size, of a ``window`` (None: of all), brought into the lens's own picture,
    [H, W] uint8."""
    import cv2

    down, across = window or whole(lens)
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
    windows = {key: whole(model.lenses[photo.lens]) for key, photo in model.photos.items()}
    both = [look(model, photos, gains, region, windows, end) for end in (False, True)]
    for state, seen in zip(STATES, both, strict=True):
        if len(seen.hull.points) == 0:
            raise UserError(f"the object could not be told from the room in state '{state}'; give --masks DIR")
    progress("masks: a closer look at the object")
    near, windows = nearer(region, both, model)
    closer = [look(model, photos, gains, near, windows, bool(end), before) for end, before in enumerate(both)]
    both = closer if all(len(seen.hull.points) for seen in closer) else both
    out: dict[str, np.ndarray] = {}
    for state, seen in zip(STATES, both, strict=True):
        masks, others = masks_of(model, photos, gains, seen, segmenter)
        out |= masks
        if others:
            progress(f"{state}: in {others} photographs the model found another thing; there the edge is GrabCut's")
    return out
