"""The photographs of a state, brought upright and free of tags into the work folder: what every later stage looks at.

Nothing but pixels, the focal length and the time is taken from EXIF; a place where a photograph was taken is never
copied.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Optional, TypeVar

import numpy as np

from p2gs.data.capture.sharpness import LONG_EDGE, MIN_PHOTOS, edge_blur, sharpness
from p2gs.data.capture.video import sharp_frames
from p2gs.types import UserError

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
HEIC = (".heic", ".heif")
# what cameras and phones write and FFmpeg reads, which goes by what is in a file
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mts", ".mpg", ".mpeg", ".wmv")
BLURRED = 1 / 3  # of the median sharpness: below it a photograph shows less than half of the detail of its neighbours
# pixels at a long edge of 640, see ``edge_blur``: a sharp photograph's 0.75 and on top of it (in squares) 1.7, which is
# 3.2 where features are found (at 1200): the whole first octave of SIFT, and three in four features, are gone
WIDE_EDGES = 1.9
SHORTEST = 200  # pixels of a copy's shorter side: the coarse model that masks come from has so many
MOST_PIXELS = 16384 * 12288  # of phones' largest sensors (200 megapixels); what has more is no phone's, or a bomb
# mm, "35 mm equivalent": from a circular fisheye to the longest bridge camera (a phone's hundredfold zoom has 2400)
FOCALS = (8.0, 3000.0)
FILM_DIAGONAL = 43.27  # mm; lenses' "35 mm equivalent" compares diagonals
EXIF_ORIENTATION, EXIF_MODEL, EXIF_IFD, EXIF_FOCAL_35, EXIF_FOCAL = 0x0112, 0x0110, 0x8769, 0xA405, 0x920A
UPRIGHT = {
    2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE", 6: "ROTATE_270", 7: "TRANSVERSE",
    8: "ROTATE_90",
}  # fmt: skip
VIDEO = "video"  # the device of all videos: they do not say what took them
Value = TypeVar("Value")
DEEP = 2  # folders below the given one that a hint looks into: a card has DCIM/100APPLE


@dataclass(frozen=True)
class Shot:
    """A copied photograph. name: of the copy (``start/0003.jpg``).  source: where it came from.  focal: pixels from
    EXIF, or None.

    device: what took it, for photographs that share a lens.  sharpness: variance of the Laplacian at 640 px.  alpha:
    file of the copy's alpha channel, or None.  blur: width of its edges, sigma in pixels at 640 px.
    """

    name: str
    source: str
    width: int
    height: int
    focal: Optional[float]
    device: str
    sharpness: float
    alpha: Optional[str] = None
    blur: float = 0.0

    @property
    def lens(self) -> Hashable:
        """Equal for photographs that share a lens: one device, one size, one focal length (to a pixel)."""
        return self.device, self.width, self.height, None if self.focal is None else round(self.focal)

    def to_dict(self) -> dict:
        return asdict(self)


def natural(path: Path) -> list:
    """Sort key that puts IMG_2 before IMG_10."""
    return [int(part) if part.isdecimal() else part.lower() for part in re.split(r"(\d+)", path.name)]


def listed(source: Path) -> list[Path]:
    """The photographs of a folder in order of their names. Raises UserError where there are too few or a kind cannot be
    read."""
    if source.is_file():
        kind = "one photograph" if source.suffix.lower() in PHOTOGRAPHS + HEIC else "neither a folder nor a known video"
        raise UserError(
            f"{source}: is {kind}, expected a folder of at least {MIN_PHOTOS} photographs from around the object, or "
            f"a video ({', '.join(VIDEOS)})"
        )
    if not source.is_dir():
        raise UserError(f"{source}: there is no such folder of photographs, nor such a video")
    files = sorted((p for p in source.iterdir() if p.is_file() and not p.name.startswith(".")), key=natural)
    photos = [p for p in files if p.suffix.lower() in PHOTOGRAPHS + HEIC]
    if len(photos) < MIN_PHOTOS:
        videos = [p.name for p in files if p.suffix.lower() in VIDEOS]
        hint = f"; it holds the video {videos[0]}, give that file itself" if videos else _hint_below(source)
        raise UserError(
            f"{source}: has {len(photos)} photographs, expected at least {MIN_PHOTOS} from around the object{hint}"
        )
    return photos


def _hint_below(source: Path) -> str:
    """Where the photographs of a folder lie instead: the folder below it that has the most, or nothing."""
    best, most = source, MIN_PHOTOS - 1
    for folder, below, files in os.walk(source):
        deep = len(Path(folder).relative_to(source).parts) >= DEEP
        below[:] = [] if deep else sorted(name for name in below if not name.startswith("."))
        count = sum(Path(f).suffix.lower() in PHOTOGRAPHS + HEIC and not f.startswith(".") for f in files)
        if folder != str(source) and count > most:
            best, most = Path(folder), count
    return "" if best == source else f"; its folder {best.relative_to(source)} has {most}, give that one"


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

    Raises UserError for a file that cannot be read or is too small, naming it.
    """
    if source.is_file() and source.suffix.lower() in VIDEOS:
        return [store(frame, f"{source}#{t:.2f}s", None, VIDEO, state, i, folder, size)
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
    from PIL import Image

    try:
        with _large_photographs() as usual, Image.open(path) as image:
            if image.width * image.height > MOST_PIXELS:
                raise UserError(
                    f"{path}: has {image.width}x{image.height} pixels, expected at most {MOST_PIXELS / 1e6:.0f} million"
                )
            if image.width * image.height > usual:
                image.draft("RGB", (size, size))  # JPEG: a half or less is decoded, no smaller than the copy
            image.load()
            turn, focal, device = _tags(image)
            upright = image if turn is None else image.transpose(Image.Transpose[turn])
            pixels = np.asarray(upright.convert("RGBA" if "A" in image.getbands() else "RGB"))
    except UserError:
        raise
    except Exception as err:  # PIL's readers raise whatever a damaged file leads them into
        raise UserError(f"{path}: cannot be read as a photograph ({str(err) or type(err).__name__})") from err
    focal = None if focal is None else focal / FILM_DIAGONAL * float(np.hypot(*pixels.shape[:2]))
    return store(pixels, str(path), focal, device, state, index, folder, size)


@contextmanager
def _large_photographs() -> Iterator[int]:
    """PIL reads up to ``MOST_PIXELS`` and keeps its warnings (of damaged tags) for itself; yields its own limit in
    pixels."""
    from PIL import Image

    usual = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = MOST_PIXELS
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield usual or MOST_PIXELS
    finally:
        Image.MAX_IMAGE_PIXELS = usual


def _tags(image) -> tuple[Optional[str], Optional[float], str]:
    """(turn to upright, 35 mm equivalent in mm, device) from EXIF. A tag that cannot be read counts as one that is not
    there: a photograph is not lost for it."""

    def read(tag: Callable[[], Value]) -> Optional[Value]:
        try:
            return tag()
        except Exception:  # PIL's parsers raise whatever a damaged block leads them into
            return None

    def details() -> dict:
        return image.getexif().get_ifd(EXIF_IFD)

    turn = read(lambda: UPRIGHT.get(image.getexif().get(EXIF_ORIENTATION)))
    focal = read(lambda: float(details()[EXIF_FOCAL_35]))
    if focal is not None and not FOCALS[0] <= focal <= FOCALS[1]:  # 0 and 65535 mean that it is not known
        focal = None
    model = read(lambda: str(image.getexif()[EXIF_MODEL]).strip())
    # a phone's lenses differ in it, also where it doesn't tell their 35 mm equivalent
    own = read(lambda: f"{float(details()[EXIF_FOCAL]):.2f} mm")
    return turn, focal, " ".join(filter(None, [model, own]))


def store(pixels, source: str, focal, device: str, state: str, index: int, folder: Path, size: int) -> Shot:
    """Write one copy (RGB or RGBA [H, W, 3|4] uint8, upright) and say what it is. focal: pixels of ``pixels``, or
    None. Raises UserError where the copy's shorter side is below ``SHORTEST``."""
    import cv2

    height, width = pixels.shape[:2]
    factor = min(1.0, size / max(width, height))
    if factor < 1:
        width, height = round(width * factor), round(height * factor)
    if min(width, height) < SHORTEST:
        copy = f", {width}x{height} as a copy with its longer side at {size}" if factor < 1 else ""
        raise UserError(
            f"{source}: is {pixels.shape[1]}x{pixels.shape[0]} pixels{copy}, expected at least {SHORTEST} on the "
            "shorter side"
        )
    if factor < 1:
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
    return Shot(name, source, width, height, focal, device, sharpness(pixels), alpha, edge_blur(pixels))


def drop_blurred(shots: list[Shot]) -> tuple[list[Shot], dict[str, str]]:
    """(sharp photographs, {name: why it is left out}). Raises UserError where too few are left.

    Left out is what is blurred beside its neighbours (a photograph that shook), or by itself.
    """
    median = float(np.median([s.sharpness for s in shots]))
    reasons = {}
    for s in shots:
        if s.blur > WIDE_EDGES:
            wide, most = (x * max(s.width, s.height) / LONG_EDGE for x in (s.blur, WIDE_EDGES))
            reasons[s.name] = f"blurred: its edges are {wide:.1f} px wide (sigma), expected at most {most:.1f}"
        elif s.sharpness < BLURRED * median:
            reasons[s.name] = f"blurred: sharpness {s.sharpness:.0f}, the median is {median:.0f}"
    kept = [s for s in shots if s.name not in reasons]
    if len(kept) < MIN_PHOTOS:
        film = shots[0].device == VIDEO
        where = shots[0].source.rpartition("#")[0] if film else Path(shots[0].source).parent
        advice = "move slowly" if film else "hold still for each"
        raise UserError(
            f"{where}: only {len(kept)} of {len(shots)} {'frames' if film else 'photographs'} are sharp, expected at "
            f"least {MIN_PHOTOS}; {advice}, with more light"
        )
    return kept, reasons


def lens_groups(shots: list[Shot]) -> list[dict]:
    """The photographs by lens (``Shot.lens``), as ``sfm.reconstruct`` wants them: square pixels, distortion along the
    radius, as phones have it. What is across it cannot be told from a shifted middle."""
    groups: dict[Hashable, list[Shot]] = {}
    for shot in shots:
        groups.setdefault(shot.lens, []).append(shot)
    out = []
    for mine in groups.values():
        one = mine[0]
        params = [] if one.focal is None else [one.focal, one.width / 2, one.height / 2, 0, 0]
        out.append({"names": [s.name for s in mine], "model": "RADIAL", "params": params})
    return out
