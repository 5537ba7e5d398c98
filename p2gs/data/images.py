"""Pixels of a scene: RGBA, masks and depth read in a small thread pool, checked, and down-scaled where asked.

Everything stays uint8 (depth float32). Colours are straight, as on disk; down-scaling averages premultiplied colour, so
that the colour behind alpha = 0 does not bleed into the object's edge.
"""

from __future__ import annotations

import os
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, Optional, Sequence

import numpy as np
import torch

from p2gs.data.frames import Frame
from p2gs.data.report import Report
from p2gs.types import Camera, View

DepthMode = Literal["auto", "never", "always"]
MAX_PIXELS = (
    2**26
    # of one image, 8192 x 8192: a hundred times what is trained on. A header may claim any number, for which memory is
    # asked
)
FOCAL_RANGE = (1e-2, 1e8)  # pixels; beyond it all rays are parallel, or at right angles to the camera, in float32
MIN_DEPTH = 0.1  # scene units (metres in the layouts' words); nearer is invalid, as in DTA and ArtGS


def resize_area(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Mean over the area of each new pixel. image [H, W] or [H, W, C], any dtype that cv2.INTER_AREA takes; same dtype
    out."""
    import cv2

    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def resize_nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """[height, width, ...]: the pixel of image [H, W, ...] under each new pixel's centre (cv2's INTER_NEAREST takes the
    corner's, half a pixel off)."""
    rows = ((np.arange(height) + 0.5) * image.shape[0] / height).astype(np.int64)
    cols = ((np.arange(width) + 0.5) * image.shape[1] / width).astype(np.int64)
    return image[rows[:, None], cols[None]]


def resize_depth(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """[height, width] float32: the depth at each new pixel's centre of a map [H, W], 0 where it is not known.

    Inverse depth is linear on a plane: between the pixels about the centre it is interpolated, so that a plane stays
    where it is (the nearest pixel's centre is half a pixel off where the size is halved). Where one of them is not
    known, the nearest has its say.
    """
    import cv2

    nearest = resize_nearest(depth, width, height).astype(np.float32)
    known = depth > 0
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)
    x, y = (
        (np.arange(n, dtype=np.float32) + 0.5) * size / n - 0.5
        for n, size in ((width, depth.shape[1]), (height, depth.shape[0]))
    )
    at = np.broadcast_to(x, (height, width)).copy(), np.broadcast_to(y[:, None], (height, width)).copy()
    maps = (inverse, known.astype(np.float32))
    mean, share = (cv2.remap(m, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for m in maps)
    return np.where((share > 1 - 1e-4) & (nearest > 0), 1 / np.maximum(mean, 1e-9), nearest).astype(np.float32)


def premultiply(image: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """[H, W, 4] float32 in 0..255: colour times alpha, and alpha."""
    out = np.empty((*alpha.shape, 4), np.float32)
    out[..., :3] = image
    out[..., :3] *= (alpha.astype(np.float32) * (1 / 255))[..., None]
    out[..., 3] = alpha
    return out


def to_uint8(x: np.ndarray) -> np.ndarray:
    """Numbers 0..255 rounded, an array of any shape."""
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)


def downscale_rgba(image: np.ndarray, alpha: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Straight uint8 colour [h, w, 3] and alpha [h, w], averaged premultiplied."""
    small = resize_area(premultiply(image, alpha), width, height)
    a = small[..., 3:]
    colour = np.where(a > 0, small[..., :3] * 255 / np.maximum(a, 1e-3), 0)
    return to_uint8(colour), to_uint8(a[..., 0])


def coverage(mask: np.ndarray) -> np.ndarray:
    """Alpha [H, W] of a mask file, uint8: any number above 0 is the object, as in DTA, unless most of the object is 255
    and its rim lies between.

    Such a mask was drawn with soft edges. Read as "above 0" it grows the object by half a pixel on all sides.
    """
    if mask.dtype == np.uint8 and 2 * np.count_nonzero(mask == 255) > np.count_nonzero(mask):
        return mask.copy()
    return np.where(mask > 0, 255, 0).astype(np.uint8)


def colour_of_rim(image: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Straight colour [H, W, 3] with the soft edge's pixels that were blacked out filled from their neighbours (two
    pixels far at most).

    DTA's images are cut out along half of a mask's value: what is below is black, a rim that no object has.
    """
    import cv2

    black = ~image.any(axis=2)
    unknown = black & (alpha > 0) & (alpha < 255)
    known = (alpha > 0) & ~unknown
    out = image.copy()
    for _ in range(2):
        if not unknown.any():
            break
        count = cv2.blur(known.astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT)
        total = cv2.blur(np.where(known[..., None], out, 0).astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT)
        found = unknown & (count > 1e-6)
        out[found] = to_uint8(total[found] / count[found][:, None])
        known, unknown = known | found, unknown & ~found
    return out


def _decode(path: Path, report: Report) -> Optional[np.ndarray]:
    import cv2

    if not path.is_file():
        report.error(f"{path}: file is missing")
        return None
    if not header_fits(path, report):
        return None
    try:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        report.error(f"{path}: cannot be read as an image")
    elif image.dtype not in (np.uint8, np.uint16):
        report.error(f"{path}: holds {image.dtype} values, expected 8 or 16 bits a channel")
        return None
    return image


def header_fits(path: Path, report: Report) -> bool:
    """Whether an image file's header claims no more than ``MAX_PIXELS``; read before any memory is asked for. False
    after an error."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            width, height = image.size
    except Image.DecompressionBombError:
        width = height = MAX_PIXELS
    except (OSError, ValueError, SyntaxError, TypeError, OverflowError, struct.error):
        report.error(f"{path}: cannot be read as an image")
        return False
    if width * height > MAX_PIXELS:
        report.error(f"{path}: its header claims more pixels than the {MAX_PIXELS} that an image may have")
        return False
    return True


def _read_alpha(frame: Frame, image: np.ndarray, report: Report) -> Optional[np.ndarray]:
    if frame.mask is None:
        if image.ndim != 3 or image.shape[2] != 4:
            report.error(
                f"{frame.image}: has no alpha channel; the alpha of an RGBA image is the object's mask in this layout"
            )
            return None
        alpha = image[..., 3]
    else:
        mask = _decode(frame.mask, report)
        if mask is None:
            return None
        # cv2 gives BGR: index 2 is the file's first channel
        mask = mask if mask.ndim == 2 else mask[..., min(2, mask.shape[2] - 1)]
        if mask.shape != image.shape[:2]:
            report.error(
                f"{frame.mask}: is {mask.shape[1]}x{mask.shape[0]} pixels, but its image is "
                f"{image.shape[1]}x{image.shape[0]}"
            )
            return None
        alpha = coverage(mask)
    if not alpha.any():
        report.error(f"{frame.mask or frame.image}: mask is empty, no pixel belongs to the object")
        return None
    if alpha.min() == 255:
        report.note(
            f"{frame.mask or frame.image}: mask covers the whole image, so nothing parts the object from its background"
        )
    return alpha


def _read_depth(frame: Frame, shape: tuple[int, int], report: Report) -> Optional[np.ndarray]:
    assert frame.depth is not None
    depth = _decode(frame.depth, report)
    if depth is None:
        return None
    if depth.ndim != 2 or depth.dtype != np.uint16:
        report.error(f"{frame.depth}: depth should be a 16-bit single-channel PNG in millimetres")
        return None
    if depth.shape != shape:
        (h, w), (height, width) = depth.shape, shape
        if abs(w * height - h * width) > max(w, h, width, height):
            report.error(f"{frame.depth}: is {w}x{h} pixels, which is not the shape of its {width}x{height} image")
            return None
        report.note(
            f"{frame.depth}: is {w}x{h} pixels and is brought to the image's {width}x{height} by nearest neighbour"
        )
        depth = resize_nearest(depth, width, height)
    out = depth.astype(np.float32) * np.float32(1e-3)
    out[out < MIN_DEPTH] = 0
    return out


def _check_fit(K: np.ndarray, frame: Frame, width: int, height: int, report: Report) -> bool:
    if frame.size not in (None, (width, height)):
        report.error(
            f"{frame.image}: is {width}x{height} pixels, but {frame.K_source} says {frame.size[0]}x{frame.size[1]}"
        )
        return False
    low, high = FOCAL_RANGE
    if not (low < K[0, 0] < high and low < K[1, 1] < high):
        report.error(
            f"{frame.K_source}: focal length of {K[0, 0]:g} x {K[1, 1]:g} pixels for {frame.image.name} is none of a "
            "photograph"
        )
        return False
    cx, cy = K[0, 2], K[1, 2]
    point, image = f"principal point ({cx:.1f}, {cy:.1f})", f"the {width}x{height} image {frame.image.name}"
    if not (0 < cx < width and 0 < cy < height):
        report.error(f"{frame.K_source}: K does not fit {image}, its {point} lies outside")
        return False
    if abs(cx - width / 2) > 0.2 * width or abs(cy - height / 2) > 0.2 * height:
        report.note(f"{frame.K_source}: {point} is far from the centre of {image}")
    return True


def read_view(frame: Frame, report: Report, downscale: float = 1.0, depth: DepthMode = "auto") -> Optional[View]:
    """The frame's ``View`` in input units, or None after an error in ``report``."""
    pixels = _decode(frame.image, report)
    if pixels is None:
        return None
    if pixels.ndim == 3 and pixels.shape[2] not in (3, 4):
        report.error(f"{frame.image}: has {pixels.shape[2]} channels, expected 1, 3 or 4")
        return None
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    alpha = _read_alpha(frame, pixels, report)
    height, width = pixels.shape[:2]
    K = frame.intrinsics(width, height)
    if not _check_fit(K, frame, width, height, report) or alpha is None:
        return None
    colour = np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels[..., 2::-1]
    if frame.mask is not None:
        colour = colour_of_rim(colour, alpha)
    z = None
    if depth != "never" and frame.depth is not None:
        z = _read_depth(frame, (height, width), report)
        if z is None:
            return None
        z[alpha < 128] = 0
        if not z.any():
            report.note(f"{frame.depth}: holds no depth of at least {MIN_DEPTH:g} inside the mask")
    elif depth == "always":
        report.error(f"{frame.image}: has no depth, but the option depth=always asks for it")
        return None
    camera = Camera(torch.from_numpy(frame.viewmat).float(), torch.from_numpy(K).float(), width, height)
    if downscale != 1.0:
        w, h = max(1, round(width / downscale)), max(1, round(height / downscale))
        colour, alpha = downscale_rgba(colour, alpha, w, h)
        z = None if z is None else resize_depth(z, w, h)
        camera = camera.scaled(w, h)
    return View(
        frame.name,
        frame.state,
        frame.split,
        camera,
        torch.from_numpy(np.ascontiguousarray(colour)),
        torch.from_numpy(np.ascontiguousarray(alpha)),
        None if z is None else torch.from_numpy(z),
    )


def check_sizes(frames: Sequence[Frame], views: Sequence[View], report: Report) -> None:
    """One K is for one image size: where no size is told with it, an error names the first image that differs from
    those that share its K."""
    read = {(v.state, v.split, v.name): (v.camera.width, v.camera.height) for v in views}
    first: dict = {}
    for f in frames:
        size = read.get((f.state, f.split, f.name))
        if f.K is None or f.size is not None or size is None:
            continue
        other, name = first.setdefault((f.K_source, f.K.tobytes()), (size, f.image.name))
        if size != other:
            report.error(
                f"{f.image}: is {size[0]}x{size[1]} pixels, but {name} with the same K is {other[0]}x{other[1]}"
            )
            return


def read_views(
    frames: Sequence[Frame], report: Report, downscale: float = 1.0, depth: DepthMode = "auto"
) -> list[View]:
    """All frames that can be read, in order. Files are decoded by a few threads; findings keep the order of the
    frames."""
    import cv2

    cv2.setNumThreads(0)  # the pool below is the parallelism; cv2's own threads would fight it

    def read(frame: Frame):
        own = Report()
        return read_view(frame, own, downscale, depth), own

    views = []
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        futures = [pool.submit(read, f) for f in frames]
        try:
            for future in futures:
                view, own = future.result()
                report.extend(own.findings)
                if view is not None:
                    views.append(view)
        finally:
            for future in futures:
                future.cancel()
    return views
