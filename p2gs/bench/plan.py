"""What a bench runs: objects x settings x seeds, read from a YAML file such as ``configs/bench/paris.yaml``.

name: paris                        # result folder runs/bench/<name> unless out says otherwise
tables: [main_result]              # tables of the paper to fill (names of p2gs/bench/data/published/*.csv)
root: data                         # the tree that holds the objects' folders; --root DIR
objects: [paris]                   # benchmarks, object ids, scene folders below root; null: every scene folder
config: [preset/cpu.yaml]          # laid under every run; --preset NAME takes that preset instead of this one
settings:                          # name -> what it changes
  full: {}
  no_repel: {config: [ablation/no_repel.yaml]}
  k_plus_2: {num_parts: gt+2}      # relative to the object's true number of parts
seeds: [0, 1, 2]
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Iterable, Iterator, Optional, Union

from p2gs.bench.options import BenchOptions, Setting
from p2gs.config.files import Layer, overrides_layer, parse_overrides, read_config
from p2gs.config.schema import Given, Keys, Plain, check_keys, keys_of, merge
from p2gs.registry import suggest
from p2gs.types import UserError

GT = re.compile(r"gt\s*(?:([+-])\s*(\d+))?")


@dataclass(frozen=True)
class Scene:
    """One object of a bench: its name in the tables, where it lies, its true number of parts (None: not known)."""

    name: str
    column: str
    root: str
    format: Optional[str] = None
    source: Optional[str] = None
    parts: Optional[int] = None


@dataclass(frozen=True)
class Cell:
    """One run. words: of ``p2gs fit`` without ``--run``.  key: changes with all that decides the result.  donors: run
    folders that may hold finished stages of the same object and seed.
    """

    object: str
    setting: str
    seed: int
    run: str
    words: tuple[str, ...]
    key: str
    parts: Optional[int] = None
    export: tuple[str, ...] = ()
    donors: tuple[str, ...] = ()
    threads: Optional[int] = None
    timeout_minutes: Optional[float] = None

    @property
    def name(self) -> str:
        return f"{self.object} {self.setting} seed {self.seed}"


class Bench:
    """A bench that was read and checked. Attributes: ``options``, ``settings`` by name, ``scenes``, ``cells``."""

    def __init__(self, options: BenchOptions, settings: dict[str, Setting], tree: Plain):
        self.options, self.settings, self.tree = options, settings, tree
        self.scenes = list(find_scenes(options))
        if not self.scenes:
            raise UserError(f"{options.root}: holds no scene of a known layout")
        self.cells = list(self._expand())

    def _expand(self) -> Iterator[Cell]:
        """Setting by setting: the first ones make the stages that later ones take over."""
        o = self.options
        donors: dict[tuple[str, int], list[str]] = {}
        for name, setting in self.settings.items():
            merged = self._merged(setting)
            for scene in self.scenes:
                parts = resolve_parts(self.parts_of(setting), scene)
                for seed in o.seeds:
                    decides = [
                        merged,
                        o.set,
                        setting.set,
                        parts,
                        scene.name,
                        scene.format,
                        scene.source,
                        seed,
                        o.export,
                    ]
                    key = hashlib.sha256(json.dumps(decides, sort_keys=True, default=str).encode()).hexdigest()[:16]
                    run = str(o.folder / "runs" / name / scene.name / f"seed{seed}")
                    before = donors.setdefault((scene.name, seed), [])
                    yield Cell(
                        object=scene.name,
                        setting=name,
                        seed=seed,
                        run=run,
                        words=self.words(setting, scene, seed),
                        key=key,
                        parts=scene.parts,
                        export=tuple(o.export),
                        donors=tuple(before) if o.reuse else (),
                        threads=o.threads,
                        timeout_minutes=o.timeout_minutes,
                    )
                    before.append(run)

    def _merged(self, setting: Setting) -> Plain:
        """The config files' content: a changed file is another result."""
        tree: Plain = {}
        for name in self.files(setting):
            for layer in read_config(name):
                tree = merge(tree, layer.tree)
        return tree

    def files(self, setting: Setting) -> list[str]:
        return [*self.options.base, *setting.config]

    def parts_of(self, setting: Setting) -> Optional[Union[int, str]]:
        """The setting's number of parts, or else the bench's."""
        return self.options.num_parts if setting.num_parts is None else setting.num_parts

    def words(self, setting: Setting, scene: Scene, seed: int) -> tuple[str, ...]:
        """The words of ``p2gs fit``."""
        return (*(word for name in self.files(setting) for word in ("-c", name)), *self.overrides(setting, scene, seed))

    def overrides(self, setting: Setting, scene: Scene, seed: int) -> list[str]:
        words = ["--data.root", scene.root]
        if scene.format is not None:
            words += ["--data.format", scene.format]
        if scene.source is not None:
            words += ["--data.source", scene.source]
        words += ["--seed", str(seed)]
        parts = resolve_parts(self.parts_of(setting), scene)
        if parts is not None:
            words += ["--num_parts", parts]
        for key, value in {**self.options.set, **setting.set}.items():
            words += [f"--{key}", value if isinstance(value, str) else json.dumps(value)]
        return words

    def check_settings(self) -> None:
        """Build every setting's config once, so that a mistake is told before anything runs. Raises UserError."""
        from p2gs.config.run import load_config

        for name, setting in self.settings.items():
            try:
                load_config(self.files(setting), self.overrides(setting, self.scenes[0], self.options.seeds[0]))
            except UserError as err:
                raise UserError(f"settings.{name}: {err}") from err


def resolve_parts(wanted: Optional[Union[int, str]], scene: Scene) -> Optional[str]:
    """``gt+2`` -> "6" for an object of four parts; never below 2.

    Raises UserError where the truth is not known or the text means nothing.
    """
    if wanted is None or wanted == "auto" or isinstance(wanted, int) or str(wanted).isdigit():
        return None if wanted is None else str(wanted)
    match = GT.fullmatch(str(wanted).strip().lower())
    if match is None:
        raise UserError(f"num_parts: expected a number, auto, gt or gt+N, got '{wanted}'")
    if scene.parts is None:
        raise UserError(
            f"num_parts: {wanted} needs the true number of parts of {scene.name}, which has no ground truth"
        )
    sign, number = match.groups()
    return str(max(scene.parts + (int(number) if number else 0) * (-1 if sign == "-" else 1), 2))


def find_scenes(options: BenchOptions) -> Iterator[Scene]:
    """The objects of a bench, in its order. Raises UserError where a named one is not in the tree."""
    from p2gs.data.objects import benchmarks, find_objects, pick_objects

    root = Path(options.root)
    if not root.is_dir():
        raise UserError(f"root: there is no folder {root} (--root DIR names the tree that holds the objects)")
    if options.format is not None:
        yield from own_scenes(root, options.format, options.objects)
        return
    if options.objects is None:
        yield from local_scenes(root)
        return
    known = {"all", *benchmarks(), *(o.id for group in benchmarks().values() for o in group)}
    own = {s.name: s for s in local_scenes(root)} if set(options.objects) - known else {}
    missing: list[str] = []
    for name in dict.fromkeys(options.objects):
        if name in own:
            yield own[name]
            continue
        if name not in known:
            raise UserError(
                f"objects: {root} has no scene '{name}', and no benchmark has{suggest(name, [*known, *own])}"
            )
        objects = pick_objects([name])
        places = find_objects(root, objects)
        missing += [o.id for o in objects if o.id not in places]
        for o in objects:
            if o.id in places:
                where = places[o.id]
                yield Scene(o.id, o.column, str(where.root), where.format, where.source, o.parts)
    if missing:
        raise UserError(
            f"{root}: lacks {', '.join(missing)} (p2gs data prepare {root} says more; --objects names fewer)"
        )


def own_scenes(root: Path, format: str, objects: Optional[list[str]]) -> Iterator[Scene]:
    """The folders right below ``root`` (those named by ``objects``), as scenes of a format of the user's own. Raises
    UserError."""
    folders = {path.name: path for path in sorted(root.iterdir()) if path.is_dir() and not path.name.startswith(".")}
    for name in folders if objects is None else objects:
        if name not in folders:
            raise UserError(f"objects: {root} has no folder '{name}'{suggest(name, folders)}")
        yield Scene(name, name, str(folders[name]), format)


def local_scenes(root: Path) -> Iterator[Scene]:
    """Every scene folder below ``root``, named by its folder (by its path where two folders have one name)."""
    from p2gs.data.ground_truth import load_ground_truth
    from p2gs.data.layouts import detect_format
    from p2gs.data.objects import scene_folders

    folders = scene_folders(root)
    names = [f.resolve().name for f in folders]
    for folder, name in zip(folders, names, strict=True):
        if names.count(name) > 1:
            name = "_".join(folder.relative_to(root).parts)
        format = detect_format(folder)
        truth = load_ground_truth(folder, format)
        yield Scene(name, name, str(folder), format, None, None if truth is None else len(truth.joints) + 1)


# -- reading ----------------------------------------------------------------------------------------------------------


def read_bench(
    files: Iterable[str],
    words: Iterable[str] = (),
    objects: Optional[list[str]] = None,
    settings: Optional[list[str]] = None,
) -> Bench:
    """The bench of YAML files (merged in order, ``include`` works).

    words: overrides as on the command line; those that name no option of a bench (``--phases.articulation.steps 100``)
    go to every fit.
    objects: instead of the files' (benchmarks, ids, or scene folders below root by name).  settings: of the files',
    these only. Raises UserError.
    """
    keys = {**keys_of(BenchOptions), "settings": None}
    own, for_fit = [], {}
    for key, value in parse_overrides(list(words)):
        if key.split(".")[0] in keys:
            own.append((key, value))
        else:
            for_fit[key] = value
    layers = [layer for name in files for layer in read_config(name)]
    layers += [overrides_layer(own), Layer({"set": for_fit})]
    tree: Plain = {}
    for layer in layers:
        tree = merge(tree, _checked(layer.tree, keys, layer.where))
    given = {name: value for name, value in (tree.pop("settings", None) or {"full": {}}).items() if value is not None}
    given = {name: given[name] for name in only(settings, given, "settings")}
    if objects:
        tree["objects"] = list(objects)
    options: BenchOptions = Given(BenchOptions, tree).make()
    built = {name: Given(Setting, value, f"settings.{name}.").make() for name, value in given.items()}
    return Bench(options, built, {**tree, "settings": given})


def _checked(tree: Plain, keys: Keys, where: str) -> Plain:
    """The tree, after its keys were found to exist; ``null`` for a setting removes it."""
    settings = tree.get("settings") or {}
    if not isinstance(settings, dict):
        raise UserError(f"{where}settings: expected name: {{config: [...]}}, got {settings!r}")
    check_keys(tree, keys, where)
    for name, value in settings.items():
        if not re.fullmatch(r"[\w.+-]+", str(name)):
            raise UserError(f"{where}settings: '{name}' names a folder, so letters, digits and ._+- only")
        if value is not None:
            if not isinstance(value, dict):
                raise UserError(f"{where}settings.{name}: expected options (key: value), got {value!r}")
            check_keys(value, keys_of(Setting), f"{where}settings.{name}: ")
    return tree


def only(names: Optional[list[str]], known: Iterable[str], what: str) -> list[str]:
    """``names`` in the order of ``known``; all where none is given. Raises UserError for an unknown one."""
    known = list(known)
    for name in names or ():
        if name not in known:
            raise UserError(f"--{what}: there is no '{name}'{suggest(name, known)}")
    return [name for name in known if not names or name in names]
