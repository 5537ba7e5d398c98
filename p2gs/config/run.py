"""The config of a run: several YAML files and single fields of the command line, merged, checked and turned into typed
objects.

Losses and callbacks are sections keyed by the name they are registered under. A section that is mentioned is on (``{}``
= on with defaults), ``null`` switches it off, what is not mentioned is off; later files and the command line merge into
earlier ones field by field. ``callbacks`` at the top is for all phases; a phase's own ``callbacks`` merge into it.
"""

from __future__ import annotations

import functools
import importlib
import os
import pkgutil
import sys
from pathlib import Path
from typing import Any, Iterable, Optional

from p2gs.callbacks.base import CALLBACKS, Callback
from p2gs.config.class_path import plain_sections, with_class_paths
from p2gs.config.files import Layer, overrides_layer, parse_overrides, read_config, to_yaml
from p2gs.config.keys import Options, data_class, run_keys
from p2gs.config.schema import Given, Keys, Plain, check_keys, known_part, merge
from p2gs.config.trainer import check_trainer_options
from p2gs.data.base import DATASETS, TwoStateData
from p2gs.data.layouts import format_of
from p2gs.losses.base import LOSSES, Loss
from p2gs.models.phase import PHASES
from p2gs.provenance import provenance
from p2gs.registry import Registry, load_plugins
from p2gs.types import UserError, short


class PhaseSection:
    """A phase's part of the config. config: instance of ``Phase.Config``.  losses, callbacks: those switched on, by
    name.

    callbacks are those of all phases (``shared``, as given) with what the phase's own section says laid on them.
    """

    def __init__(self, name: str, tree: Plain, shared: Plain):
        phase, path = PHASES[name], f"phases.{name}."
        self._own: Plain = tree.get("callbacks") or {}
        self._config = Given(phase.Config, {k: v for k, v in tree.items() if k not in ("losses", "callbacks")}, path)
        self._on: dict[str, dict[str, Given]] = {}
        if getattr(phase, "trained", True):
            self._on["losses"] = switched_on(LOSSES, tree.get("losses") or {}, f"{path}losses.")
            self._on["callbacks"] = switched_on(CALLBACKS, merge(shared, self._own), f"{path}callbacks.")
        self.config: Any = self._config.make()
        self.losses: dict[str, Loss] = {name: given.make() for name, given in self._on.get("losses", {}).items()}
        self.callbacks = self.new_callbacks()

    def new_callbacks(self) -> dict[str, Callback]:
        """Fresh callbacks, for a phase that runs more than once."""
        return {name: given.make() for name, given in self._on.get("callbacks", {}).items()}

    def decisive(self) -> Plain:
        """What decides the phase's result: its options, losses, and callbacks that change it."""
        idle = {name for name, callback in self.callbacks.items() if not callback.changes_result}
        on = {k: {n: g.values for n, g in on.items() if n not in idle or k == "losses"} for k, on in self._on.items()}
        return {**self._config.values, **on}

    def to_dict(self) -> Plain:
        """All of it; of the callbacks what the phase's own section says, so that a later file still reaches the
        others."""
        if not self._on:
            return self._config.values
        full = {name: given.values for name, given in self._on["callbacks"].items()}
        own = {name: None if given is None else {k: full[name][k] for k in given} for name, given in self._own.items()}
        losses = written(LOSSES, self._on["losses"])
        return {**self._config.values, "losses": losses, "callbacks": with_class_paths(own, CALLBACKS)}


def switched_on(registry: Registry, tree: Plain, path: str) -> dict[str, Given]:
    """The registered classes that the tree mentions, but those it says null of."""
    on = {name: cls for name, cls in registry.items() if tree.get(name) is not None}
    return {name: Given(cls, tree[name], f"{path}{name}.") for name, cls in on.items()}


def written(registry: Registry, on: dict[str, Given]) -> Plain:
    """Every registered name with its options, null where it is off."""
    return with_class_paths({name: on[name].values if name in on else None for name in registry}, registry)


class RunConfig(Options):
    """The merged config. Attributes: those of ``Options``, ``phases`` (name -> PhaseSection), ``data`` (built when
    first asked for)."""

    trainer: Plain

    def __init__(self, tree: Plain, data_format: Optional[str]):
        """tree: merged, its keys checked."""
        self._options = Given(Options, {k: v for k, v in tree.items() if k not in ("data", "phases", "callbacks")})
        vars(self).update(vars(self._options.make()))
        check_trainer_options(self.trainer)
        given = {k: v for k, v in (tree.get("data") or {}).items() if k != "format"}
        self._given_data = Given(data_class(data_format), given, "data.")
        self.data_options: Plain = {"format": data_format, **self._given_data.values}
        shared, phases = tree.get("callbacks") or {}, tree.get("phases") or {}
        self._callbacks = switched_on(CALLBACKS, shared, "callbacks.")
        self.phases = {name: PhaseSection(name, phase, shared) for name, phase in phases.items() if phase is not None}

    @functools.cached_property
    def data(self) -> TwoStateData:
        """The data module. Raises UserError when no format or no required option (root) is given."""
        if self.data_options["format"] is None:
            raise UserError(f"data.format is not given (--data.format NAME); known: {', '.join(sorted(DATASETS))}")
        made = self._given_data.make()
        made.strict_paths = self.strict_paths
        return made

    @property
    def scene_name(self) -> str:
        """Name of the scene: its folder's, or the format's where the data come from no folder."""
        root = self.data_options.get("root")
        return Path(root).resolve().name if root else str(self.data_options["format"] or "run")

    @property
    def run_dir(self) -> Path:
        """The result folder."""
        return Path(self.run) if self.run else Path("runs") / self.scene_name

    def phase_config(self, name: str) -> Any:
        """Options of a phase; their defaults where this config does not mention it. Raises UserError for an unknown
        name."""
        return self.phases[name].config if name in self.phases else PHASES[name].Config()

    def section(self, name: str) -> Any:
        """What decides the result of a phase, the data's options or a top-level option, as plain values. Raises
        KeyError."""
        if name in self.phases:
            return self.phases[name].decisive()
        return self.data_options if name == "data" else self._options.values[name]

    def to_dict(self) -> Plain:
        """The whole merged config, defaults included, as plain values: ``load_config`` reads it back."""
        phases = {name: section.to_dict() for name, section in self.phases.items()}
        phases |= {name: None for name in PHASES if name not in phases}
        return {
            **self._options.values,
            "data": self.data_options,
            "phases": phases,
            "callbacks": written(CALLBACKS, self._callbacks),
        }


# -- loading ----------------------------------------------------------------------------------------------------------


def load_config(files: Iterable[str] = (), overrides: Iterable[str] = (), plugins: Iterable[str] = ()) -> RunConfig:
    """Merge ``files`` in order, then ``overrides`` (words as on the command line: ``["--seed", "1"]``), check, build.

    Raises UserError with one sentence: an unknown key names the nearest right one and the file it is in.
    """
    layers = [layer for name in files for layer in read_config(str(name))]
    layers.append(overrides_layer(parse_overrides(list(overrides))))
    return config_of(layers, plugins)


def config_of(layers: list[Layer], plugins: Iterable[str] = ()) -> RunConfig:
    """The config that the layers make, each laid on those before it."""
    names = [*plugins]
    for layer in layers:
        given = layer.tree.get("plugins") or []
        given = [given] if isinstance(given, str) else given
        names += Given(Options, {"plugins": given}, layer.where).values["plugins"]
    load_plugins(tuple(dict.fromkeys(names)))
    import_builtins()
    layers = [Layer(plain_sections(layer.tree, layer.where), layer.where) for layer in layers]

    formats, root = [None], None  # of each layer: its own format or the last one before it
    for layer in layers:
        data = layer.tree.get("data")
        data = data if isinstance(data, dict) else {}
        formats.append(data.get("format") or formats[-1])
        if not isinstance(formats[-1], (str, type(None))):
            raise UserError(f"{layer.where}data.format: expected text, got {short(formats[-1])}")
        root = data.get("root") or root
    last = format_of(Path(root)) if formats[-1] is None and isinstance(root, str) else formats[-1]
    keys, merged = run_keys(last), {}
    for layer, name in zip(layers, formats[1:], strict=True):
        tree = checked(layer, keys if name in (None, last) else run_keys(name))
        merged = merge(merged, tree)
    merged.pop("p2gs", None)
    merged["plugins"] = list(dict.fromkeys(names))
    if merged.get("data"):  # another format came later: keep what it knows too
        merged["data"] = {k: v for k, v in merged["data"].items() if k in keys["data"]}
    return RunConfig(merged, last)


def checked(layer: Layer, keys: Keys) -> Plain:
    """The layer's tree, its keys checked. One that ``save_config`` wrote may be another version's: options that are no
    more are left out, with a note, so that finished runs stay readable. Raises UserError for any other wrong key."""
    tree = layer.tree
    if "p2gs" in tree:
        tree, gone = known_part(tree, keys)
        if gone:
            _tell_left_out(layer.where, tuple(gone))
    check_keys(tree, keys, layer.where)
    return tree


@functools.lru_cache
def _tell_left_out(where: str, gone: tuple[str, ...]) -> None:
    """Once a process, though a config is read more than once."""
    print(f"note: {where}left out, as this version has no such option: {', '.join(gone)}", file=sys.stderr, flush=True)


def import_builtins() -> None:
    """Import every module of the packages that register things, so that their names are known."""
    for package in ("losses", "callbacks", "models", "data"):
        module = importlib.import_module(f"p2gs.{package}")
        for info in pkgutil.iter_modules(module.__path__):
            importlib.import_module(f"p2gs.{package}.{info.name}")
    importlib.import_module("p2gs.runtime.finish")


# -- saving -----------------------------------------------------------------------------------------------------------


def save_config(cfg: RunConfig, path: Path) -> None:
    """Write the merged config with version, git commit and command line (under ``p2gs``); ``-c`` reads it back."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(to_yaml({"p2gs": provenance(), **cfg.to_dict()}), encoding="utf-8")
    os.replace(part, path)
