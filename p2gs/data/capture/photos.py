"""The photographs of a state, brought upright and free of tags into the work folder: what every later stage looks at.

Nothing but pixels, the focal length and the time is taken from EXIF; a place where a photograph was taken is never
copied.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.capture.sharpness import MIN_PHOTOS, sharpness
from p2gs.data.capture.video import sharp_frames
from p2gs.types import UserError

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
HEIC = (".heic", ".heif")
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
BLURRED = 1 / 3  # of the median sharpness: below it a photograph shows less than half of the detail of its neighbours
EXIF_ORIENTATION, EXIF_MODEL, EXIF_IFD, EXIF_FOCAL_35, EXIF_FOCAL = 0x0112, 0x0110, 0x8769, 0xA405, 0x920A
FILM_DIAGONAL = 43.27  # mm; lenses' "35 mm equivalent" compares diagonals


@dataclass(frozen=True)
class Shot:
    """A copied photograph. name: of the copy (``start/0003.jpg``).  source: where it came from.  focal: pixels from
    EXIF, or None.

    device: what took it, for photographs that share a lens.  sharpness: variance of the Laplacian at 640 px.  alpha:
    file of the copy's alpha channel, or None.
    """

    name: str
    source: str
    width: int
    height: int
    focal: Optional[float]
    device: str
    sharpness: float
    alpha: Optional[str] = None

    def to_dict(self) -> dict:
        return asdict(self)


def natural(path: Path) -> list:
    """Sort key that puts IMG_2 before IMG_10."""
    return [int(part) if part.isdigit() else part.lower() for part in re.split(r"(\d+)", path.name)]


def listed(source: Path) -> list[Path]:
    """The photographs of a folder in order of their names. Raises UserError where there are too few or a kind cannot be
    read."""
    if not source.is_dir():
        raise UserError(f"{source}: there is no such folder of photographs, nor such a video")
    files = sorted((p for p in source.iterdir() if p.is_file() and not p.name.startswith(".")), key=natural)
    photos = [p for p in files if p.suffix.lower() in PHOTOGRAPHS + HEIC]
    if len(photos) < MIN_PHOTOS:
        videos = [p.name for p in files if p.suffix.lower() in VIDEOS]
        hint = f"; it holds the video {videos[0]}, give that file itself" if videos else ""
        raise UserError(
            f"{source}: has {len(photos)} photographs, expected at least {MIN_PHOTOS} from around the object{hint}"
        )
    return photos


def heic_opener() -> bool:
    """Whether HEIC can be read (pillow-heif is there)."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


def copy_photos(source: Path, state: str, folder: Path, size: int, limit: int) -> list[Shot]:
    """Upright copies of a state's photographs as ``folder/state/NNNN.jpg``, at most ``limit``, long edge at most
    ``size``.

    Raises UserError for a file that cannot be read, naming it.
    """
    if source.is_file() and source.suffix.lower() in VIDEOS:
        return [store(frame, f"{source}#{t:.2f}s", None, "video", state, i, folder, size)
                for i, (t, frame) in enumerate(sharp_frames(source, limit))]  # fmt: skip
    paths = listed(source)
    if any(p.suffix.lower() in HEIC for p in paths) and not heic_opener():
        first = next(p for p in paths if p.suffix.lower() in HEIC)
        raise UserError(
            f"{first}: HEIC needs pillow-heif (pip install 'p2gs[heic]'), or set the phone to take JPEG ('most "
            "compatible')"
        )
    if len(paths) > limit:
        paths = [paths[i] for i in np.linspace(0, len(paths) - 1, limit).round().astype(int)]
    return [_copied(path, state, i, folder, size) for i, path in enumerate(paths)]


def _copied(path: Path, state: str, index: int, folder: Path, size: int) -> Shot:
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            exif = image.getexif()
            focal, device = _focal_35(exif), str(exif.get(EXIF_MODEL, "")).strip()
            pixels = np.asarray(ImageOps.exif_transpose(image).convert("RGBA" if "A" in image.getbands() else "RGB"))
    except (
        OSError,
        UnidentifiedImageError,
        Image.DecompressionBombError,
        ValueError,
        SyntaxError,
        OverflowError,
    ) as err:
        raise UserError(f"{path}: cannot be read as a photograph ({err})") from err
    if min(pixels.shape[:2]) < 200:
        raise UserError(
            f"{path}: is {pixels.shape[1]}x{pixels.shape[0]} pixels, expected at least 200 on the shorter side"
        )
    focal = None if focal is None else focal / FILM_DIAGONAL * float(np.hypot(*pixels.shape[:2]))
    return store(pixels, str(path), focal, device, state, index, folder, size)


def _focal_35(exif) -> Optional[float]:
    """The lens's 35 mm equivalent in mm, from EXIF."""
    try:
        value = float(exif.get_ifd(EXIF_IFD).get(EXIF_FOCAL_35, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return value if value > 5 else None


def store(pixels, source: str, focal, device: str, state: str, index: int, folder: Path, size: int) -> Shot:
    """Write one copy (RGB or RGBA [H, W, 3|4] uint8, upright) and say what it is. focal: pixels of ``pixels``, or
    None."""
    import cv2

    height, width = pixels.shape[:2]
    factor = min(1.0, size / max(width, height))
    if factor < 1:
        width, height = round(width * factor), round(height * factor)
        pixels = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    name = f"{state}/{index:04d}.jpg"
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.ascontiguousarray(pixels[..., 2::-1]), [cv2.IMWRITE_JPEG_QUALITY, 97])
    alpha = None
    if pixels.shape[2] == 4 and pixels[..., 3].min() < 255:
        alpha = str(Path(name).with_suffix(".alpha.png"))
        cv2.imwrite(str(folder / alpha), pixels[..., 3])
    focal = None if focal is None else focal * factor
    return Shot(name, source, width, height, focal, device, sharpness(pixels), alpha)


def drop_blurred(shots: list[Shot]) -> tuple[list[Shot], dict[str, str]]:
    """(sharp photographs, {name: why it is left out}). Raises UserError where too few are left."""
    median = float(np.median([s.sharpness for s in shots]))
    reasons = {
        s.name: f"blurred: sharpness {s.sharpness:.0f}, the median is {median:.0f}"
        for s in shots
        if s.sharpness < BLURRED * median
    }
    kept = [s for s in shots if s.name not in reasons]
    if len(kept) < MIN_PHOTOS:
        where = Path(shots[0].source).parent
        raise UserError(
            f"{where}: only {len(kept)} of {len(shots)} photographs are sharp; hold still for each, with more light"
        )
    return kept, reasons


def lens_groups(shots: list[Shot]) -> list[dict]:
    """The photographs by lens (device and size), as ``sfm.reconstruct`` wants them: square pixels, distortion along the
    radius, as phones have it. What is across it cannot be told from a shifted middle."""
    groups: dict[tuple, list[Shot]] = {}
    for shot in shots:
        groups.setdefault((shot.device, shot.width, shot.height), []).append(shot)
    out = []
    for (_, width, height), mine in groups.items():
        known = [s.focal for s in mine if s.focal]
        params = []
        if known:
            focal = float(np.median(known))
            params = [focal, width / 2, height / 2, 0, 0]
        out.append({"names": [s.name for s in mine], "model": "RADIAL", "params": params})
    return out
