"""Classes by ``class_path`` and ``init_args``, as Lightning's own configs have them: loggers, callbacks, data and
losses of the user's.

``losses: {mine: {class_path: my_losses.Mine, init_args: {weight: 0.1}}}`` is ``losses: {mine: {weight: 0.1}}`` of a
class registered as ``mine``; ``data: {class_path: my_data.Mine, init_args: {...}}`` is ``data: {format: my_data.Mine,
...}``.
"""

from __future__ import annotations

import dataclasses
import importlib
import os
import sys
import warnings
from typing import Any, Optional

from p2gs.registry import Registry
from p2gs.types import UserError, short

Plain = dict[str, Any]
EXPECTED = "class_path: MODULE.CLASS and init_args: {NAME: VALUE}"


def given_class(value: Any, where: str) -> Optional[tuple[str, Plain]]:
    """(class_path, init_args) of a section that names a class, None of any other. Raises UserError where it is
    malformed."""
    if not isinstance(value, dict) or "class_path" not in value:
        return None
    path, args = value["class_path"], value.get("init_args") or {}
    if not isinstance(path, str) or not isinstance(args, dict):
        raise UserError(f"{where}: expected {EXPECTED}, got {short(value)}")
    return path, args


def import_class(path: str, base: type, where: str) -> type:
    """The class of a dotted path. Raises UserError where there is none, or it is no subclass of ``base``."""
    module, _, name = path.rpartition(".")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        made = getattr(importlib.import_module(module), name) if module else None
    except (ImportError, AttributeError, ValueError) as err:
        raise UserError(f"{where}: class_path {short(path)} cannot be imported ({err})") from err
    if not (isinstance(made, type) and issubclass(made, base)):
        raise UserError(f"{where}: class_path {short(path)} is no {base.__module__}.{base.__qualname__}")
    return made


def register_class(path: str, name: str, registry: Registry, base: type, where: str) -> None:
    """Make the class known as ``name``. Raises UserError where the name is another's already."""
    cls = import_class(path, base, where)
    if name in registry and registry[name] is not cls and name not in registry.paths:
        raise UserError(f"{where}: '{name}' is the name of a {registry.kind} already; give your class another one")
    if not dataclasses.is_dataclass(cls) or "__dataclass_fields__" not in vars(cls):
        cls = dataclasses.dataclass(eq=False)(cls) if registry.kind != "data format" else cls
    registry.put(name, cls, path)


def plain_sections(tree: Plain, where: str) -> Plain:
    """The config with every class of losses, callbacks and data registered and its ``init_args`` as options."""
    from p2gs.callbacks.base import CALLBACKS, Callback
    from p2gs.data.base import DATASETS, TwoStateData
    from p2gs.losses.base import LOSSES, Loss

    def named(sections: Any, registry: Registry, base: type, prefix: str) -> Any:
        if not isinstance(sections, dict):
            return sections
        out = {}
        for name, value in sections.items():
            given = given_class(value, f"{where}{prefix}{name}")
            if given is not None:
                register_class(given[0], str(name), registry, base, f"{where}{prefix}{name}")
                value = given[1] | {k: v for k, v in value.items() if k not in ("class_path", "init_args")}
            out[name] = value
        return out

    out = dict(tree)
    if "callbacks" in out:
        out["callbacks"] = named(out["callbacks"], CALLBACKS, Callback, "callbacks.")
    if isinstance(out.get("phases"), dict):
        out["phases"] = dict(out["phases"])
        for name, phase in out["phases"].items():
            if isinstance(phase, dict):
                found = dict(phase)
                for kind, registry, base in (("losses", LOSSES, Loss), ("callbacks", CALLBACKS, Callback)):
                    if kind in phase:
                        found[kind] = named(phase[kind], registry, base, f"phases.{name}.{kind}.")
                out["phases"][name] = found
    data = out.get("data")
    given = given_class(data, f"{where}data")
    path = given[0] if given is not None else data.get("format") if isinstance(data, dict) else None
    if isinstance(path, str) and "." in path and path not in DATASETS:
        register_class(path, path, DATASETS, TwoStateData, f"{where}data")
    if given is not None and data is not None:
        rest = {k: v for k, v in data.items() if k not in ("class_path", "init_args")}
        out["data"] = {"format": path, **given[1], **rest}
    return out


def with_class_paths(sections: Plain, registry: Registry) -> Plain:
    """What ``plain_sections`` took apart, put together again for a file that is read back."""
    named = {n: v for n, v in sections.items() if n in registry.paths and v is not None}
    return sections | {n: {"class_path": registry.paths[n], "init_args": v} for n, v in named.items()}


def instance(value: Any, base: type, where: str, **defaults: Any) -> Any:
    """The object of ``{class_path, init_args}`` or of a bare class path; Lightning's own classes go by their name, too.

    defaults: arguments that are taken where the class has them and none are given. Raises UserError in one sentence.
    """
    import inspect

    from jsonargparse import ArgumentParser

    value = {"class_path": value} if isinstance(value, str) else value
    given = given_class(value, where)
    if given is None or value.keys() - {"class_path", "init_args"}:
        raise UserError(f"{where}: expected {EXPECTED}, got {short(value)}")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(base, "value", required=True)
    try:
        path = parser.parse_object({"value": {"class_path": given[0]}}).value.class_path if defaults else given[0]
    except Exception:  # arguments are lacking, or there is no such class: told below
        path = given[0] if "." in given[0] else f"{base.__module__.rsplit('.', 1)[0]}.{given[0]}"
    try:
        module, _, name = path.rpartition(".")
        taken = inspect.signature(getattr(importlib.import_module(module), name).__init__).parameters
        args = {k: v for k, v in defaults.items() if k in taken} | given[1]
        config = parser.parse_object({"value": {"class_path": path, "init_args": args}})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # jsonargparse's own, of the method's coming name
            return parser.instantiate_classes(config)["value"]
    except UserError:
        raise
    except Exception as err:
        raise UserError(f"{where}: {_in_one_line(err)}") from err


def _in_one_line(err: Exception) -> str:
    """What jsonargparse found wrong, without its account of what it tried."""
    text = str(err)
    if "Errors:" in text:
        text = text.split("Errors:", 1)[1].split("- Expected a <class 'NoneType'>")[0].split("Given value type")[0]
    text = text.split("Given value type")[0]
    return " ".join(text.split()).removeprefix("- ") or type(err).__name__
