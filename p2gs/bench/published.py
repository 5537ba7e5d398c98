"""The paper's tables as data: every number with its table, row, object and metric; footnotes on those that contradict
each other."""

from __future__ import annotations

import csv
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

from p2gs.registry import suggest
from p2gs.types import UserError

DATA = Path(__file__).parent / "data"


@dataclass(frozen=True)
class Metric:
    """How a metric is printed. digits: after the point, as the paper has it.  source: of the sampling floor and the
    failures."""

    name: str
    title: str
    digits: int = 2
    higher_is_better: bool = False


METRICS = {
    m.name: m
    for m in (
        Metric("ang", "Ang Err"),
        Metric("pos", "Pos Err"),
        Metric("motion", "Motion Err"),
        Metric("cd_static", "CD static"),
        Metric("cd_movable", "CD movable"),
        Metric("cd_whole", "CD whole"),
        Metric("cd_static_seen", "CD static, seen"),
        Metric("cd_movable_seen", "CD movable, seen"),
        Metric("cd_whole_seen", "CD whole, seen"),
        Metric("psnr", "PSNR", 1, True),
        Metric("ssim", "SSIM", 3, True),
        Metric("lpips", "LPIPS", 3),
        Metric("minutes", "Time (min)", 1),
        Metric("penetration", "Penetration", 3),
        Metric("extra", "Parts too many", 1),
        Metric("spare", "Gaussians in spare slots (%)", 1),
    )
}
CHAMFER = ("cd_static", "cd_movable", "cd_whole")
SEEN = tuple(f"{name}_seen" for name in CHAMFER)  # without the faces that are guessed


@dataclass(frozen=True)
class Published:
    """One printed number. value: None where the paper prints a dash or F (``text`` says which).  std: None where none
    is printed."""

    row: str
    object: str
    metric: str
    value: Optional[float]
    std: Optional[float]
    text: str
    marked: str


@dataclass(frozen=True)
class Footnote:
    """A sentence and where it belongs."""

    text: str
    at: tuple[dict, ...]

    def applies(self, table: str, row: str, object: str, metric: str) -> bool:
        here = {"table": table, "row": row, "object": object, "metric": metric}
        return any(all(here[k] in (v if isinstance(v, list) else [v]) for k, v in place.items()) for place in self.at)


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper; see ``data/tables.yaml``. rows, objects, metrics: in the printed order."""

    name: str
    title: str
    layout: str
    ours: dict[str, Optional[str]]
    numbers: dict[tuple[str, str, str], Published]
    reference: Optional[str] = None
    blocks: tuple[tuple[str, ...], ...] = ()

    def _order(self, at: int) -> list[str]:
        return list(dict.fromkeys(key[at] for key in self.numbers))

    @property
    def rows(self) -> list[str]:
        return self._order(0)

    @property
    def objects(self) -> list[str]:
        return self._order(1)

    @property
    def metrics(self) -> list[str]:
        return self._order(2)


def _yaml(name: str):
    import yaml

    return yaml.safe_load((DATA / name).read_text(encoding="utf-8"))


@functools.cache
def table_names() -> tuple[str, ...]:
    return tuple(_yaml("tables.yaml"))


@functools.cache
def paper_table(name: str) -> PaperTable:
    """A table by name (``main_result``, ``tab:main_result``). Raises UserError for an unknown one."""
    name = name.removeprefix("tab:")
    tables = _yaml("tables.yaml")
    if name not in tables:
        raise UserError(f"the paper has no table '{name}'{suggest(name, tables)}")
    spec = tables[name]
    numbers = {}
    with open(DATA / "published" / f"{name}.csv", newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            text = line["value"]
            value = None if text in ("-", "F") else float(text)
            std = float(line["std"]) if line["std"] else None
            key = (line["row"], line["object"], line["metric"])
            numbers[key] = Published(*key, value, std, text, line["marked"])
    blocks = tuple(tuple(block) for block in spec.get("blocks", ()))
    return PaperTable(name, spec["title"], spec["layout"], spec["ours"], numbers, spec.get("reference"), blocks)


@functools.cache
def footnotes() -> tuple[Footnote, ...]:
    return tuple(Footnote(f["text"], tuple(f["at"])) for f in _yaml("footnotes.yaml"))
