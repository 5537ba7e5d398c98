"""What decides a stage's result, as plain values by name: options, code, the scene's files. Its hash is the stage's
key."""

from __future__ import annotations

import hashlib
import json
import os
from functools import cached_property
from pathlib import Path
from typing import Any, Iterable

from p2gs.config.trainer import callback_modules, decides_result
from p2gs.context import RunContext
from p2gs.models.stage import Stage
from p2gs.runtime.code import CodeReader

MOST_TOLD = 3  # differences in a sentence
LIBRARIES = ("torch", "lightning", "typing", "abc")  # of which phases inherit; their code counts as given
Parts = dict[str, Any]


class StageKeys:
    """The keys of one run's stages. order: name -> phase."""

    def __init__(self, run: RunContext, order: dict[str, type[Stage]]):
        self.run, self.order = run, order
        self.code = CodeReader()
        self._parts: dict[str, Parts] = {}

    def key(self, name: str) -> str:
        """16 hexadecimal digits."""
        return hashlib.sha256(json.dumps(self.parts(name), sort_keys=True, default=str).encode()).hexdigest()[:16]

    def parts(self, name: str) -> Parts:
        """All that decides the result of phase ``name``: its own and what decides the phases it builds on."""
        if name not in self._parts:
            run, cfg = self.run, self.run.cfg
            parts = {option: cfg.section(option) for option in ("seed", "rasterizer")} | {"device": run.device.type}
            parts |= flat("data", cfg.section("data")) | {f"file {file}": digest for file, digest in self.files.items()}
            modules = {type(cfg.data).__module__, rasterizer_module(run.rasterizer)}
            modules |= callback_modules(cfg.trainer)
            parts |= flat("trainer", decides_result(cfg.trainer)) if decides_result(cfg.trainer) else {}
            for stage in self.deciding(name):
                phase = self.order[stage]
                parts |= flat(f"phases.{stage}", cfg.section(stage))
                if phase.num_parts_matters:
                    parts[f"num_parts of {stage}"] = phase.num_parts_key(run)
                modules |= self.modules(stage)
            parts |= {f"code of {module}": digest for module, digest in self.code.code_of(sorted(modules)).items()}
            self._parts[name] = parts
        return self._parts[name]

    def deciding(self, name: str) -> list[str]:
        """The phase and those before it that it builds on, directly or not, in their order: they hand over what it
        needs or uses, or change the scene."""
        wanted = [stage for stage, phase in self.order.items() if phase.wanted(self.run)]
        before = wanted[: wanted.index(name)] if name in wanted else wanted
        phase, found = self.order[name], {name}
        for what in (*phase.needs, *phase.uses):
            givers = [stage for stage in before if self.order[stage].gives == what]
            found |= set(self.deciding(givers[-1])) if givers else set()
        for stage in before:
            if self.order[stage].changes_scene:
                found |= set(self.deciding(stage))
        return [stage for stage in self.order if stage in found]

    def modules(self, name: str) -> set[str]:
        """The modules of a phase, of what it hands over, and of its losses and callbacks that change the result."""
        section, phase = self.run.cfg.phases[name], self.order[name]
        makers = {*phase.__mro__, *map(type, section.losses.values())}
        makers |= {type(c) for c in section.callbacks.values() if c.changes_result}
        own = {make.__module__ for make in makers} - {"builtins"}
        return {m for m in own if m.split(".")[0] not in LIBRARIES} | {"p2gs.runtime.training"}

    @cached_property
    def files(self) -> dict[str, str]:
        """Path (below the scene's folder) -> hash of the scene's files."""
        data = self.run.cfg.data
        root = getattr(data, "root", None)
        listed = data.files() if hasattr(data, "files") else []
        return scene_files(listed, Path(root or ".").resolve(), self.run.run_dir / "checkpoints" / "scene_files.json")


def changes(old: Parts, new: Parts) -> str:
    """What differs, in words: ``phases.sharpen.steps was 600, is 20; the scene's file start/0.png changed; ...``."""
    told = []
    for name in [*new, *(n for n in old if n not in new)]:
        was, now = old.get(name), new.get(name)
        if name in old and name in new and was == now:
            continue
        kind, _, rest = name.partition(" ")
        if kind in ("code", "file"):
            what = f"the code of {rest.removeprefix('of ')}" if kind == "code" else f"the scene's file {rest}"
            told.append(f"{what} {'is gone' if name not in new else 'is new' if name not in old else 'changed'}")
        else:
            told.append(f"{name} was {_short(was)}, is {_short(now)}")
    more = len(told) - MOST_TOLD
    return "; ".join(told[:MOST_TOLD]) + (f"; and {more} more" if more > 0 else "")


def _short(value: Any) -> str:
    return "not there" if value is None else str(value)[:40]


def flat(prefix: str, value: Any) -> Parts:
    """``flat("a", {"b": {"c": 1}}) == {"a.b.c": 1}``; an empty section is there, too."""
    if not isinstance(value, dict) or not value:
        return {prefix: value}
    out: Parts = {}
    for key, inner in value.items():
        out |= flat(f"{prefix}.{key}", inner)
    return out


def rasterizer_module(name: str) -> str:
    """The module of a rasterizer of the user's own, else that of all rasterizers."""
    from p2gs.render import RASTERIZERS
    from p2gs.render.base import split_backend

    base = split_backend(name)[0]
    return RASTERIZERS[base].__module__ if base in RASTERIZERS else "p2gs.render"


def scene_files(files: Iterable[Path], root: Path, cache: Path) -> dict[str, str]:
    """Path -> hash of each file's bytes, paths below ``root`` told from there. cache: where hashes are kept by size and
    time of change."""
    try:
        known = json.loads(cache.read_text())
    except (OSError, ValueError):
        known = {}
    out, seen = {}, {}
    for path in files:
        try:
            stat = path.stat()
            mark = f"{path.resolve()}:{stat.st_size}:{stat.st_mtime_ns}:{stat.st_ino}"
            digest = known.get(mark) or hashlib.blake2b(path.read_bytes(), digest_size=8).hexdigest()
        except OSError:  # the reader has told what it could not read
            continue
        seen[mark] = digest
        out[path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)] = digest
    if seen and seen != known:
        cache.parent.mkdir(parents=True, exist_ok=True)
        part = cache.with_suffix(".part")
        part.write_text(json.dumps(seen))
        os.replace(part, cache)
    return out
