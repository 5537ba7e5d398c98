"""Masks that the command made itself: ``SCENE/masks``, named after their photographs, where a user may edit them and
give them back with ``--masks``."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from p2gs.data.capture.cache import Cache, Progress
from p2gs.data.capture.photos import Shot
from p2gs.types import UserError

Masks = dict[str, np.ndarray]


def mask_names(shots: list[Shot]) -> dict[str, str]:
    """Name of a copy -> ``start/IMG_1.png``; ``start/IMG_1.jpg.png`` where an IMG_1.png is there, too, and
    ``start/walk.mp4#1.03s.png`` of a video, so that ``given_masks.mask_file`` finds each again."""
    sources = {s.name: (s.name.split("/")[0], Path(s.source)) for s in shots}
    stems = Counter((state, source.stem) for state, source in sources.values())
    return {
        name: f"{state}/{source.name if '#' in source.name or stems[state, source.stem] > 1 else source.stem}.png"
        for name, (state, source) in sources.items()
    }


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def check_unedited(cache: Cache, folder: Path) -> None:
    """Raises UserError where a mask is no longer what the command wrote: it would be lost."""
    kept = cache.kept("masks")
    for file, digest in {} if kept is None else kept["result"].items():
        if (folder / file).is_file() and _digest(folder / file) != digest:
            raise UserError(
                f"{folder / file}: was edited; give --masks {folder} to use it, or delete it to have all masks made "
                "anew"
            )


def kept_masks(
    cache: Cache, folder: Path, shots: list[Shot], depends: object, make: Callable[[], Masks], progress: Progress
) -> Masks:
    """The masks [H, W] uint8 by copy's name, of photographs that show the object, from ``folder`` where what they
    depend on is unchanged, else made and written there."""
    import cv2

    names, before = mask_names(shots), cache.kept("masks")

    def write() -> dict:
        masks, files = make(), {}
        for file in {} if before is None else before["result"]:
            (folder / file).unlink(missing_ok=True)
        for shot in shots:  # a photograph without a mask has a black one, so that the folder can be given back
            name, mask = shot.name, masks.get(shot.name, np.zeros((shot.height, shot.width), np.uint8))
            path = folder / names[name]
            path.parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(path), mask):
                raise UserError(f"{path}: cannot be written")
            files[names[name]] = _digest(path)
        return files

    files = cache.get("masks", depends, write, progress, lambda result: all((folder / f).is_file() for f in result))
    copies, out = {file: name for name, file in names.items()}, {}
    for file in files:
        mask = cv2.imread(str(folder / file), cv2.IMREAD_GRAYSCALE)
        assert mask is not None  # its bytes are those that were written
        if mask.any():
            out[copies[file]] = mask
    return out
