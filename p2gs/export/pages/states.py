"""``p2gs predict``: pictures and a video of a finished run's twin at any state."""

from __future__ import annotations

from pathlib import Path
from typing import Optional, Sequence

from p2gs.export.pages.media import chosen_camera, framed, render_parts, render_plain, save_png
from p2gs.export.pages.video import turntable_frames, write_video
from p2gs.gaussians.paint import rasterizer_of
from p2gs.gaussians.twin_json import load_twin
from p2gs.gaussians.views import read_cameras


def render_states(
    run_dir: Path | str,
    times: Sequence[float],
    out: Optional[Path | str] = None,
    size: Optional[int] = None,
    video: bool = False,
) -> list[Path]:
    """Pictures of a finished run at any state times: t<time>.png and parts_t<time>.png in ``out`` (default
    RUN/media/states).

    Times outside [0, 1] go on along each joint. size: longer side in pixels (default 512). video: also
    motion.mp4 from start to end and back on a turntable (motion.gif and frames/ where imageio-ffmpeg is not installed).

    Raises UserError when the run has no twin.
    """
    run_dir = Path(run_dir)
    obj = load_twin(run_dir)
    folder = Path(out) if out is not None else run_dir / "media" / "states"
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with rasterizer_of(run_dir):
        base, _ = chosen_camera(obj, [c.camera for c in read_cameras(run_dir / "cameras.json")])
        camera, _ = framed(obj, base, size or 512)
        for t in times:
            for prefix, image in (("", render_plain(obj, camera, t)), ("parts_", render_parts(obj, camera, t))):
                written.append(folder / f"{prefix}t{t:.3f}.png")
                save_png(written[-1], image)
        if video:
            written += write_video(folder, list(turntable_frames(obj, size or 512)))
    return written
