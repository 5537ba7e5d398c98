"""What a running bench shows: a live matrix on a terminal, a line a run where the output is a file."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from typing import Iterator, Optional

from p2gs.bench.cell import Outcome, read_record
from p2gs.bench.plan import Bench, Cell

SIGNS = {"todo": ("·", "dim"), "running": ("▶", "yellow"), "done": ("●", "green"), "failed": ("F", "bold red")}


def duration(seconds: float) -> str:
    """``0:07``, ``1:02:03``."""
    hours, rest = divmod(int(round(seconds)), 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"


class Display:
    """Told by the runner what happens. terminal: live matrix or plain lines; found out when not given."""

    def __init__(self, bench: Bench, terminal: Optional[bool] = None):
        self.bench = bench
        self.terminal = sys.stdout.isatty() if terminal is None else terminal
        self.live = None

    @contextmanager
    def on(self, known: dict[str, str], slots: int) -> Iterator[None]:
        """While the bench runs. known: status by run, kept up to date by the runner."""
        self.known, self.slots = known, slots
        self.seconds: list[float] = []  # of the runs that ended in this sitting
        self.errors: list[tuple[str, str]] = []
        self.began: dict[str, float] = {}
        before = sum(s == "done" for s in known.values())
        print(
            f"{self.bench.options.name}: {len(known)} runs, {before} done before; results in "
            f"{self.bench.options.folder}",
            flush=True,
        )
        if not self.terminal:
            yield
            print(self.summary(), flush=True)
            return
        from rich.live import Live

        with Live(auto_refresh=False, transient=True) as self.live:
            yield
        self.live = None
        from rich import print as rich_print

        rich_print(self.matrix())
        print(self.summary(), flush=True)

    def started(self, cell: Cell) -> None:
        self.began[cell.name] = time.monotonic()
        if not self.terminal:
            print(f"[{self.finished()}/{len(self.known)}] {cell.name}: started", flush=True)

    def ended(self, cell: Cell, outcome: Outcome) -> None:
        if outcome.seconds > 0:
            self.seconds.append(outcome.seconds)
        if outcome.error:
            self.errors.append((cell.name, outcome.error))
        if not self.terminal:
            what = f"FAILED: {outcome.error}" if outcome.error else "done"
            left = self.left()
            rest = "" if left is None or left == 0 else f", about {duration(left)} left"
            print(
                f"[{self.finished()}/{len(self.known)}] {cell.name}: {what} in {duration(outcome.seconds)}{rest}",
                flush=True,
            )

    def lost(self, cell: Cell, outcome: Outcome) -> None:
        """The run is handed over again."""
        if not self.terminal:
            print(f"[{self.finished()}/{len(self.known)}] {cell.name}: lost ({outcome.error}); again", flush=True)

    def finished(self) -> int:
        return sum(s in ("done", "failed") for s in self.known.values())

    def left(self) -> Optional[float]:
        """Seconds to go: the runs to come at the mean length of those that ended, less what the running ones have
        behind them."""
        times = self.seconds
        if not times:  # nothing yet in this sitting: what the records say
            times = [read_record(c.run).get("seconds", 0.0) for c in self.bench.cells if self.known[c.name] == "done"]
        if not any(times):
            return None
        mean, now = sum(times) / len(times), time.monotonic()
        todo = sum(s == "todo" for s in self.known.values()) * mean
        running = [
            max(mean - (now - self.began[n]), 0.0) for n, s in self.known.items() if s == "running" and n in self.began
        ]
        return max((todo + sum(running)) / self.slots, max(running, default=0.0))

    def refresh(self) -> None:
        if self.live is not None:
            self.live.update(self.matrix(), refresh=True)

    def matrix(self):
        """Objects down, settings across, one sign a seed."""
        from rich.box import SIMPLE_HEAD
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table(box=SIMPLE_HEAD)
        table.add_column("object")
        for name in self.bench.settings:
            table.add_column(name, justify="center")
        signs: dict[tuple[str, str], Text] = {}
        for cell in self.bench.cells:
            sign, style = SIGNS.get(self.known[cell.name], SIGNS["todo"])
            signs.setdefault((cell.object, cell.setting), Text()).append(sign, style)
        for scene in self.bench.scenes:
            table.add_row(scene.name, *(signs.get((scene.name, setting), Text()) for setting in self.bench.settings))
        left = self.left()
        rest = "time left not known yet" if left is None else f"about {duration(left)} left"
        lines = [Text(f"{self.finished()}/{len(self.known)} runs, {rest}")]
        lines += [
            Text(f"{name}: {error}", "red", no_wrap=True, overflow="ellipsis") for name, error in self.errors[-5:]
        ]
        return Group(table, *lines)

    def summary(self) -> str:
        """The last line."""
        done, failed = (sum(s == kind for s in self.known.values()) for kind in ("done", "failed"))
        text = f"{done} of {len(self.known)} runs done" + (f", {failed} failed" if failed else "")
        for name, error in self.errors[:10]:
            text += f"\n  {name}: {error}"
        return text
