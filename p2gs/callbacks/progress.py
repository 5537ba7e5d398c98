"""``progress``: one live line on a terminal, a plain line now and then where the output is a file."""

from __future__ import annotations

import sys
import time
from typing import Any

from p2gs.callbacks.base import Callback, register_callback


def duration(seconds: float) -> str:
    """``0:07``, ``1:02:03``."""
    seconds = int(round(seconds))
    hours, rest = divmod(seconds, 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"


def status_line(phase, steps_per_second: float, losses: int = 4) -> str:
    """Phase, step, losses (the largest first), Gaussians, steps a second, time left."""
    scalars = {k.removeprefix("loss/"): float(v) for k, v in phase.scalars.items()}
    total = scalars.pop("total", None)
    shown = sorted(scalars.items(), key=lambda item: -abs(item[1]))[:losses]
    words = [] if total is None else [f"loss {total:.4f}"]
    words += [f"{name} {value:.4f}" for name, value in shown]
    words.append(f"{phase.num_gaussians:,} Gaussians")
    if steps_per_second > 0:
        words.append(f"{steps_per_second:.0f}/s" if steps_per_second >= 10 else f"{steps_per_second:.1f}/s")
        words.append(f"{duration((phase.total_steps - phase.step) / steps_per_second)} left")
    return f"{phase.phase_name} {phase.step}/{phase.total_steps}  " + "  ".join(words)


@register_callback("progress")
class Progress(Callback):
    """every_seconds: between two updates of the live line.  plain_seconds: between two lines where stdout is no
    terminal.
    losses: how many losses are shown beside the total.
    """

    changes_result = False
    every_seconds: float = 0.25
    plain_seconds: float = 10.0
    losses: int = 4

    def __post_init__(self):
        self._live: Any = None  # rich.live.Live

    def on_train_start(self, trainer, phase) -> None:
        self._started = self._shown = time.monotonic()
        self._first_step = phase.step
        self._plain = not sys.stdout.isatty()
        if not self._plain:
            from rich.live import Live

            self._live = Live(auto_refresh=False, transient=True)
            self._live.start()

    def on_step(self, trainer, phase) -> None:
        now = time.monotonic()
        if now - self._shown < (self.plain_seconds if self._plain else self.every_seconds):
            return
        self._shown = now
        line = self._line(phase, now)
        if self._plain:
            print(line, flush=True)
        elif self._live is not None:
            from rich.text import Text

            self._live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)

    def _line(self, phase, now: float) -> str:
        elapsed = now - self._started
        return status_line(phase, (phase.step - self._first_step) / elapsed if elapsed > 0 else 0.0, self.losses)

    def on_train_end(self, trainer, phase) -> None:
        self._stop()
        now = time.monotonic()
        line = self._line(phase, now).rsplit("  ", 1)[0]  # no time left
        print(f"{line}  {duration(now - self._started)} done", flush=True)

    def on_exception(self, trainer, phase, exception) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None
