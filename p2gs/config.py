"""The config of a run: several YAML files and single fields of the command line, merged, checked and turned into typed objects.

Losses and callbacks are sections keyed by the name they are registered under. A section that is mentioned is on (``{}`` = on
with defaults), ``null`` switches it off, what is not mentioned is off; later files and the command line merge into earlier ones
field by field. ``callbacks`` at the top is for all phases; a phase's own ``callbacks`` merge into it.
"""

from __future__ import annotations

import dataclasses
import importlib
import os
import pkgutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, Iterable, Optional

from p2gs.class_path import plain_sections, with_class_paths
from p2gs.config_files import Layer, overrides_layer, parse_overrides, provenance, read_config, to_yaml
from p2gs.registry import load_plugins
from p2gs.run_schema import Options, dataset_names, run_schema
from p2gs.schema import Plain, Section, build, check_keys, complete, merge, plain
from p2gs.trainer_options import check_trainer_options
from p2gs.types import UserError, short

if TYPE_CHECKING:
    from lightning.pytorch import LightningDataModule

    from p2gs.callbacks.base import Callback
    from p2gs.losses.base import Loss


class PhaseSection:
    """A phase's part of the config. config: instance of ``Phase.Config``.  losses, callbacks: those switched on, by name."""

    def __init__(self, config: Any, losses: dict[str, "Loss"], callbacks_section: Section, callbacks: Plain):
        self.config = config
        self.losses = losses
        self._callbacks = (callbacks_section, callbacks)
        self.callbacks = self.new_callbacks()

    def new_callbacks(self) -> dict[str, "Callback"]:
        """Fresh callbacks, for a phase that runs more than once."""
        section, values = self._callbacks
        return build(values, section, "callbacks.")


class RunConfig:
    """The merged config. Attributes: those of ``Options``, ``phases`` (name -> PhaseSection), ``data`` (built when first asked for)."""

    def __init__(self, values: Plain, schema: Section):
        self._values = values  # completed: every key, typed
        self._schema = schema
        own = Section(Options, {f.name: schema.children[f.name] for f in dataclasses.fields(Options)})
        options: Options = build({name: values[name] for name in own.children}, own)
        self.seed, self.run, self.device, self.threads = options.seed, options.run, options.device, options.threads
        self.rasterizer, self.num_parts, self.plugins = options.rasterizer, options.num_parts, options.plugins
        self.exact_parts, self.strict_paths, self.stages = options.exact_parts, options.strict_paths, options.stages
        self.trainer: Plain = values["trainer"] or {}
        check_trainer_options(self.trainer)
        self.data_options: Plain = values["data"]
        self._data: Optional[LightningDataModule] = None
        self.phases: dict[str, PhaseSection] = {}
        for name, phase in values["phases"].items():
            if phase is not None:
                self.phases[name] = self._phase(name, phase)

    def _phase(self, name: str, values: Plain) -> PhaseSection:
        section = self._schema.children["phases"].children[name]
        fields = Section(section.make, {k: c for k, c in section.children.items() if k not in ("losses", "callbacks")})
        config = build({k: values[k] for k in fields.children}, fields, f"phases.{name}.")
        if "losses" not in section.children:
            return PhaseSection(config, {}, self._schema.children["callbacks"], complete({}, self._schema.children["callbacks"]))
        losses = build(values["losses"], section.children["losses"], f"phases.{name}.losses.")
        callbacks = complete(merge(self._values["callbacks"], values["callbacks"]), self._schema.children["callbacks"])
        return PhaseSection(config, losses, self._schema.children["callbacks"], callbacks)

    @property
    def data(self) -> "LightningDataModule":
        """The data module. Raises UserError when no format or no required option (root) is given."""
        if self._data is None:
            options = {k: v for k, v in self.data_options.items() if k != "format"}
            if self.data_options["format"] is None:
                raise UserError(f"data.format is not given (--data.format NAME); known: {', '.join(sorted(dataset_names()))}")
            section = self._schema.children["data"]
            section = Section(section.make, {k: c for k, c in section.children.items() if k != "format"})
            self._data = build(options, section, "data.")
            self._data.strict_paths = self.strict_paths
        return self._data

    @property
    def scene_name(self) -> str:
        """Name of the scene: its folder's, or the format's where the data come from no folder."""
        root = self.data_options.get("root")
        if isinstance(root, (str, Path)) and str(root):
            return Path(root).resolve().name
        return str(self.data_options["format"] or "run")

    @property
    def run_dir(self) -> Path:
        """The result folder."""
        return Path(self.run) if self.run else Path("runs") / self.scene_name

    def phase_config(self, name: str) -> Any:
        """Options of a phase; their defaults where this config does not mention it. Raises UserError for an unknown name."""
        from p2gs.models.phase import PHASES

        return self.phases[name].config if name in self.phases else PHASES[name].Config()

    def section(self, name: str) -> Plain:
        """What decides the result of a phase (its fields, enabled losses, callbacks that change the result), or a top-level key.

        Plain values, for hashing. Raises KeyError for an unknown name.
        """
        if name not in self.phases:
            return plain(self._values[name])
        phase, values = self.phases[name], plain(self._values["phases"][name])
        if "losses" not in values:
            return values
        values["losses"] = {k: v for k, v in values["losses"].items() if v is not None}
        values["callbacks"] = {k: plain(c) for k, c in phase.callbacks.items() if c.changes_result}
        return values

    def to_dict(self) -> Plain:
        """The whole merged config, defaults included, as plain values: ``load_config`` reads it back."""
        from p2gs.callbacks.base import CALLBACKS
        from p2gs.losses.base import LOSSES

        out = plain(self._values)
        for place in (out, *filter(None, out["phases"].values())):
            for kind, registry in (("losses", LOSSES), ("callbacks", CALLBACKS)):
                if kind in place:
                    place[kind] = with_class_paths(place[kind], registry)
        return out


# -- loading -----------------------------------------------------------------------------------------------------------------------


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
        if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
            raise UserError(f"{layer.where}plugins: expected a list of modules, got {short(given)}")
        names += given
    names = list(dict.fromkeys(map(str, names)))
    load_plugins(tuple(names))
    import_builtins()
    layers = [Layer(plain_sections(layer.tree, layer.where), layer.where) for layer in layers]

    formats, current, root = [], None, None
    for layer in layers:
        data = layer.tree.get("data")
        if isinstance(data, dict):
            current, root = data.get("format") or current, data.get("root") or root
            if current is not None and not isinstance(current, str):
                raise UserError(f"{layer.where}data.format: expected text, got {short(current)}")
        formats.append(current)
    if current is None and isinstance(root, str):
        current = _format_found(Path(root))
    schema = run_schema(current)
    merged: Plain = {}
    for layer, name in zip(layers, formats, strict=True):
        check_keys(layer.tree, schema if name in (None, current) else run_schema(name), layer.where)
        tree = layer.tree
        if isinstance(tree.get("data"), dict):  # another format later: keep what it knows too
            tree = {**tree, "data": {k: v for k, v in tree["data"].items() if k in schema.children["data"].children}}
        merged = merge(merged, tree)
    merged.pop("p2gs", None)
    merged["plugins"] = names
    merged.setdefault("data", {})
    merged["data"] = {**(merged["data"] or {}), "format": current}
    values = complete(merged, schema)
    values.pop("p2gs")
    phases = merged.get("phases") or {}
    values["phases"] = {name: values["phases"][name] for name in dict.fromkeys([*phases, *values["phases"]])}  # in the order of the files
    for name, phase in phases.items():
        if phase is not None and "callbacks" in values["phases"][name]:  # a phase's callbacks say only what differs from the top
            given = complete(phase.get("callbacks") or {}, schema.children["callbacks"])
            values["phases"][name]["callbacks"] = _mentioned(given, phase.get("callbacks") or {})
    return RunConfig(values, schema)


def _format_found(root: Path) -> str:
    """The data format that the folder given as data.root looks like. Raises UserError where it is none, or there is no such folder."""
    from p2gs.data.layouts import LAYOUTS, detect_format

    try:
        present = root.is_dir()
    except (OSError, ValueError):  # a name that no folder can have
        present = False
    if not present:
        raise UserError(f"data.root: the folder {str(root)[:300]} is not there")
    found = detect_format(root)
    if found is None:
        known = ", ".join(LAYOUTS)
        raise UserError(f"data.format is not given, and {root} looks like none of the layouts {known}; give --data.format NAME")
    return found


def _mentioned(values: Plain, tree: Plain) -> Plain:
    return {k: _mentioned(values[k], v) if isinstance(v, dict) and isinstance(values[k], dict) else values[k] for k, v in tree.items()}


def import_builtins() -> None:
    """Import every module of the packages that register things, so that their names are known."""
    for package in ("losses", "callbacks", "models", "data"):
        module = importlib.import_module(f"p2gs.{package}")
        for info in pkgutil.iter_modules(module.__path__):
            importlib.import_module(f"p2gs.{package}.{info.name}")
    for stage in ("discovery", "finish"):
        importlib.import_module(f"p2gs.runtime.{stage}")


# -- saving ------------------------------------------------------------------------------------------------------------------------


def save_config(cfg: RunConfig, path: Path) -> None:
    """Write the merged config with version, git commit and command line (under ``p2gs``); ``-c`` reads it back."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(to_yaml({"p2gs": provenance(), **cfg.to_dict()}), encoding="utf-8")
    os.replace(part, path)
