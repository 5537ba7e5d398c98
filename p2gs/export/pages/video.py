"""Turntable videos of the motion: H.264 where imageio-ffmpeg is installed, else a GIF and all frames as PNG."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Iterator, Sequence

import numpy as np

from p2gs.export.pages.media import render_parts, render_plain, resize, save_png
from p2gs.gaussians.views import best_camera, orbit
from p2gs.types import ArticulatedObject

FPS = 24


def turntable_frames(obj: ArticulatedObject, size: int = 512, seconds: float = 5.0) -> Iterator[np.ndarray]:
    """Frames [size, 2 size, 3] uint8: colour beside part colours, once from t = 0 to 1 and back while the camera swings
    past the front.

    The camera starts from the side where most of the moving parts shows and sweeps 60 degrees to either side.
    """
    size -= size % 2
    count, ring = round(seconds * FPS), orbit(obj, 180, size=(size, size))
    front = 6 * best_camera(obj, ring[::6])
    for i in range(count):
        phase = 2 * math.pi * i / count
        t = (1 - math.cos(phase)) / 2
        camera = ring[(front + round(25 * math.sin(phase))) % len(ring)]
        yield np.concatenate([render_plain(obj, camera, t), render_parts(obj, camera, t)], axis=1)


def write_video(folder: Path, frames: Sequence[np.ndarray], fps: int = FPS) -> list[Path]:
    """Frames [H, W, 3] uint8 of even size as ``motion.mp4``; without imageio-ffmpeg as ``motion.gif`` and
    ``frames/0000.png`` ..."""
    try:
        import imageio_ffmpeg
    except ImportError:
        stills = folder / "frames"
        stills.mkdir(parents=True, exist_ok=True)
        for i, frame in enumerate(frames):
            save_png(stills / f"{i:04d}.png", frame)
        return [write_gif(folder / "motion.gif", frames, fps), stills]
    h, w = frames[0].shape[:2]
    path = folder / "motion.mp4"
    writer = imageio_ffmpeg.write_frames(
        str(path), (w, h), fps=fps, codec="libx264", pix_fmt_out="yuv420p", macro_block_size=2
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    return [path]


def write_gif(path: Path, frames: Sequence[np.ndarray], fps: int = FPS, width: int = 640) -> Path:
    """An endless GIF of every second frame, uint8 [H, W, 3] (Pillow comes with scikit-image)."""
    from PIL import Image

    h, w = frames[0].shape[:2]
    width = min(width, w)
    images = [Image.fromarray(resize(f, width, round(h * width / w))) for f in frames[::2]]
    images[0].save(path, save_all=True, append_images=images[1:], duration=round(2000 / fps), loop=0, optimize=True)
    return path
