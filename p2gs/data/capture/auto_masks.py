"""Masks from 3D: the object's Gaussians of a coarse splat drawn into every photograph, their edge sharpened in the
photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from p2gs.data.capture.coarse import Picture, Region, Splat, fit, initial, object_rows, region_of
from p2gs.data.capture.hull import Hull, hull_of
from p2gs.data.capture.joint import is_end, states_of
from p2gs.data.capture.model import Model
from p2gs.data.capture.segmenters import Segmenter
from p2gs.data.capture.write import pinhole_of
from p2gs.data.exposure import corrected
from p2gs.types import Camera, UserError

COARSE = 200  # px, long edge of the splat's pictures
SHARP = 480  # px, long edge that edges are sharpened at
BAND = 0.012  # of the long edge, to either side of the drawn edge: two pixels of the splat's pictures
PORE = 0.03  # of the mask: smaller holes are the coarse splat's, where a plain side gave it nothing to hold on to
CHANGED = 0.15  # share of the mask that sharpening may change before it is not believed
ALIKE = 0.5  # intersection over union of a model's mask with what the splat shows, below which it means something else


def pictures_of(model: Model, photos: Path, gains: dict[int, np.ndarray], keys: list[int], size: int) -> list[Picture]:
    """The photographs of ``keys`` undistorted, their gains taken out, at a long edge of ``size``."""
    import cv2

    out = []
    for key in keys:
        photo = model.photos[key]
        lens = model.lenses[photo.lens]
        pinhole = pinhole_of(lens)
        image = corrected(cv2.imread(str(photos / photo.name))[..., ::-1], gains.get(key, np.zeros(3)))
        image = cv2.remap(image, *pinhole.maps, cv2.INTER_LINEAR)
        factor = min(1.0, size / max(lens.width, lens.height))
        width, height = round(lens.width * factor), round(lens.height * factor)
        camera = Camera(torch.tensor(photo.viewmat).float(), torch.tensor(pinhole.K).float(), lens.width, lens.height)
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
    state, keys = "end" if end else "start", [k for k, p in model.photos.items() if is_end(p.name) == end]
    mine = states_of(model)[:, int(end)]
    splat = initial(region, model.xyz[mine], model.rgb[mine])
    pictures = pictures_of(model, photos, gains, keys, COARSE)
    fit(splat, pictures, region.distance)
    rows = object_rows(splat, region)
    hull = hull_of(region, [(p.camera, shares(splat, rows, p.camera) > 0.5) for p in pictures])
    if len(hull.points) == 0:
        raise UserError(f"the object could not be told from the room in state '{state}'; give --masks DIR")
    out, others = {}, 0
    for key, coarse, sharp in zip(keys, pictures, pictures_of(model, photos, gains, keys, SHARP), strict=True):
        found, believed = object_in(splat, rows, hull, coarse.camera, sharp, segmenter)
        mask, others = without_pores(found), others + (not believed)
        photo = model.photos[key]
        out[photo.name] = distorted(mask, model.lenses[photo.lens])
        if not out[photo.name].any():
            del out[photo.name]
    if others:
        progress(f"{state}: in {others} photographs the model found another thing; there the edge is GrabCut's")
    return out


def distorted(mask: np.ndarray, lens) -> np.ndarray:
    """An undistorted mask [h, w] bool of any size brought into the lens's own picture, [H, W] uint8."""
    import cv2

    K = pinhole_of(lens).K
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.rays(np.stack([x.ravel(), y.ravel()], 1)).reshape(lens.height, lens.width, 2)
    factor = mask.shape[1] / lens.width
    u, v = (rays[..., 0] * K[0, 0] + K[0, 2]) * factor - 0.5, (rays[..., 1] * K[1, 1] + K[1, 2]) * factor - 0.5
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
