"""Masks that are there already: the photographs' own alpha, or a folder of files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from p2gs.data.capture.photos import MIN_PHOTOS, Shot
from p2gs.data.frames import STATES
from p2gs.types import UserError

SUFFIXES = (".png", ".PNG", ".jpg", ".jpg.png", ".jpeg.png", ".JPG.png", ".webp")


def mask_file(folder: Path, shot: Shot) -> Path:
    """The mask of a photograph: ``DIR/start/IMG_1.jpg.png``, ``IMG_1.png`` and the like, or the same below DIR itself;
    of a video's frame ``walk.mp4#1.03s.png``, as capture.json names it.

    Raises UserError naming the photograph where there is none, or where both states' photographs share a name in one
    folder.
    """
    state, source = shot.name.split("/")[0], Path(shot.source)
    stem = source.name if "#" in source.name else source.stem  # frames of one second have one stem
    for base in (folder / state, folder):
        for name in (f"{source.name}.png", *(f"{stem}{suffix}" for suffix in SUFFIXES)):
            if (base / name).is_file():
                return base / name
    raise UserError(f"{folder}: has no mask for {shot.source}; expected {state}/{stem}.png, white where the object is")


def read_mask(path: Path, shot: Shot, ignore: bool) -> np.ndarray:
    """[H, W] uint8 in the size of the photograph's copy. ignore: nerfstudio's meaning, black is what is not to be
    looked at.

    Both meanings show the object white; with ``ignore`` an alpha channel is not asked. Raises UserError for another
    shape.
    """
    import cv2

    try:
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # a header that claims more than OpenCV takes
        mask = None
    if mask is None:
        raise UserError(f"{path}: cannot be read as an image")
    if mask.ndim == 3:
        mask = mask[..., 3] if mask.shape[2] == 4 and not ignore else mask[..., :3].max(2)
    if mask.dtype == np.uint16:
        mask = np.right_shift(mask, 8, dtype=np.uint16).astype(np.uint8)
    elif mask.max() == 1:
        mask = mask * 255
    height, width = mask.shape
    if abs(width * shot.height - height * shot.width) > 0.01 * width * shot.height:
        raise UserError(
            f"{path}: is {width}x{height} pixels, which is not the shape of {shot.source} "
            f"({shot.width}x{shot.height} upright)"
        )
    if (height, width) != (shot.height, shot.width):
        mask = cv2.resize(mask, (shot.width, shot.height), interpolation=cv2.INTER_AREA)
    return mask


def alpha_masks(shots: list[Shot], folder: Path) -> dict[str, np.ndarray] | None:
    """The photographs' own alpha by name, [H, W] uint8, or None unless all have one. Raises UserError for a file that
    is no image."""
    import cv2

    files = {s.name: folder / s.alpha for s in shots if s.alpha}
    if len(files) < len(shots):
        return None
    masks = {}
    for name, path in files.items():
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise UserError(f"{path}: cannot be read as an image")
        masks[name] = mask
    return shown(masks, folder)


def folder_masks(shots: list[Shot], folder: Path, ignore: bool = False) -> dict[str, np.ndarray]:
    """The masks in a folder by photograph's name. Raises UserError where a file is missing.

    A mask without a white pixel says that its photograph does not show the object: it helps to place the others and is
    not trained on.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such folder of masks")
    return shown({s.name: read_mask(mask_file(folder, s), s, ignore) for s in shots}, folder)


def shown(masks: dict[str, np.ndarray], where: Path) -> dict[str, np.ndarray]:
    """The masks with something white in them. Raises UserError where a state has fewer than ``MIN_PHOTOS`` of them."""
    out = {name: mask for name, mask in masks.items() if (mask > 127).any()}
    for state in STATES:
        left, of = (sum(n.startswith(state) for n in names) for names in (out, masks))
        if left < MIN_PHOTOS:
            raise UserError(
                f"{where}: state '{state}': {of - left} of {of} masks are empty, expected at least {MIN_PHOTOS} with "
                "white pixels"
            )
    return out
