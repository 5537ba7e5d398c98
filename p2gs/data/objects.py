"""The benchmarks' objects (``objects.yaml``) and where a downloaded tree has them."""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Iterable, Optional

from p2gs.registry import suggest
from p2gs.types import UserError

DEPTH = 6  # how far below the given folder scenes are looked for
TYPES = {"r": "revolute", "p": "prismatic"}


@dataclass(frozen=True)
class BenchmarkObject:
    """One object of a published benchmark. joints: revolute or prismatic, in the ground truth's order.  column: its
    name in the paper."""

    id: str
    benchmark: str
    joints: tuple[str, ...]
    column: str
    subset: str = "sapien"

    @property
    def parts(self) -> int:
        """The static base counted, as in the paper's tables."""
        return len(self.joints) + 1

    @property
    def source(self) -> str:
        """Its path below ``load`` in the PARIS layout."""
        return f"{self.subset}/{self.id.rsplit('_', 1)[1]}" if self.subset == "sapien" else f"{self.subset}/{self.id}"


@dataclass(frozen=True)
class Location:
    """Where a scene lies: data.root, data.format and, in the PARIS layout, data.source."""

    root: Path
    format: str
    source: Optional[str] = None


@functools.cache
def benchmarks() -> dict[str, tuple[BenchmarkObject, ...]]:
    """The objects by benchmark: paris, dta_multi, artgs_multi."""
    import yaml

    tree = yaml.safe_load((Path(__file__).parent / "objects.yaml").read_text(encoding="utf-8"))
    return {
        name: tuple(
            BenchmarkObject(o["id"], name, tuple(TYPES[j] for j in o["joints"]), o["column"], o.get("subset", "sapien"))
            for o in entry["objects"]
        )
        for name, entry in tree.items()
    }


def pick_objects(names: Iterable[str]) -> list[BenchmarkObject]:
    """Objects by benchmark (``paris``, ``all``) or by id, in that order, each once. Raises UserError for an unknown
    name."""
    lists = benchmarks()
    every = {o.id: o for group in lists.values() for o in group}
    found: dict[str, BenchmarkObject] = {}
    for name in names:
        if name == "all":
            found |= every
        elif name in lists:
            found |= {o.id: o for o in lists[name]}
        elif name in every:
            found[name] = every[name]
        else:
            raise UserError(f"there is no benchmark or object '{name}'{suggest(name, ['all', *lists, *every])}")
    return list(found.values())


def scene_folders(root: Path) -> list[Path]:
    """Folders at or below ``root`` that look like a scene of a known layout, not looking into scenes."""
    from p2gs.data.layouts import detect_format

    found: list[Path] = []
    for folder, inner, _ in os.walk(root, followlinks=True):
        path = Path(folder)
        if detect_format(path):
            found.append(path)
            inner.clear()
        elif len(path.relative_to(root).parts) >= DEPTH:
            inner.clear()
        inner.sort()
    return found


def find_objects(root: Path | str, objects: Iterable[BenchmarkObject]) -> dict[str, Location]:
    """Where each object lies in a downloaded tree: a scene folder of its name, or a source below a ``load`` folder.

    Missing ones are left out. Of an object that is there several times the ArtGS layout is taken (it has depth), then
    DTA's, then PARIS's.
    """
    from p2gs.data.layouts import detect_format
    from p2gs.data.paris import sources

    rank = {"artgs": 0, "dta": 1, "paris": 2}
    places: list[tuple[str, Location]] = []
    for folder in scene_folders(Path(root)):
        format = detect_format(folder)
        assert format is not None  # it is a scene's folder
        if format == "paris" and (folder / "load").is_dir():
            places += [(source, Location(folder, format, source)) for source in sources(folder) if source]
            if "" not in sources(folder):
                continue
        places.append((folder.name, Location(folder, format)))
    found: dict[str, Location] = {}
    for o in objects:
        hits = [where for name, where in places if name in (o.id, o.source)]
        if hits:
            found[o.id] = min(hits, key=lambda where: rank[where.format])
    return found
