"""What stages of a capture made, kept in ``SCENE/.capture`` by all that they depend on."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Optional

Progress = Callable[[str], None]


def versions() -> list[Optional[str]]:
    """Of the programs that stages run, None for one that is not installed."""
    out: list[Optional[str]] = []
    for package in ("p2gs", "pycolmap"):
        try:
            out.append(version(package))
        except PackageNotFoundError:
            out.append(None)
    return out


class Cache:
    """Results of stages, a JSON file each. A file that was cut off (the command was killed) counts as none."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def kept(self, stage: str) -> Optional[dict]:
        """{"key", "result"} of the stage's last run, whatever it depended on; None where there is none."""
        try:
            kept = json.loads((self.folder / f"{stage}.json").read_text())
        except (FileNotFoundError, ValueError):
            return None
        return kept if isinstance(kept, dict) and {"key", "result"} <= kept.keys() else None

    def get(
        self,
        stage: str,
        depends: object,
        make: Callable[[], dict],
        progress: Progress,
        whole: Callable[[dict], bool] = lambda result: True,
    ) -> dict:
        """The stage's result, from disk where ``depends`` (anything JSON knows) and the programs' versions are the same
        as when it was made and the files that go with it are there (``whole``)."""
        told = json.dumps([versions(), depends], sort_keys=True, default=str)
        key, kept = hashlib.sha256(told.encode()).hexdigest(), self.kept(stage)
        if kept is not None and kept["key"] == key and whole(kept["result"]):
            progress(f"{stage}: unchanged")
            return kept["result"]
        path = self.folder / f"{stage}.json"
        path.unlink(missing_ok=True)  # from here on its files need not be what it says
        result = make()
        part = path.with_suffix(".part")
        part.write_text(json.dumps({"key": key, "result": result}))
        os.replace(part, path)
        return result
