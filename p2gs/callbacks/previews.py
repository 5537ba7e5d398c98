"""``previews``: the same pictures as PNG files in ``RUN/media/previews``."""

from __future__ import annotations

from dataclasses import field

from p2gs.callbacks.base import Callback, due, register_callback, run_folder


@register_callback("previews")
class Previews(Callback):
    """every: steps between pictures, 0 = only at the end of the phase.  times: states to render.  Older ones are kept
    when ``keep``."""

    changes_result = False
    every: int = 0
    times: list[float] = field(default_factory=lambda: [0.0, 0.5, 1.0])
    keep: bool = False

    def on_step(self, trainer, phase) -> None:
        if not due(phase.step, self.every, phase.total_steps):
            return
        import cv2

        folder = run_folder(trainer) / "media" / "previews"
        folder.mkdir(parents=True, exist_ok=True)
        for name, image in phase.preview(self.times).items():
            stem = name.replace("/", "_") + (f"_{phase.step:06d}" if self.keep else "")
            cv2.imwrite(str(folder / f"{stem}.png"), image.cpu().numpy()[..., ::-1])
