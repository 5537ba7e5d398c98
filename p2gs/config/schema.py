"""Typed sections of a config: jsonargparse reads the options of a class, checks given ones, knows the defaults and
makes the object.

Merging is ours, on plain dicts: jsonargparse (hence LightningCLI) replaces a ``dict[str, Loss]`` as a whole where it
should merge, without a word; and so is the sentence for a mistake, which names the nearest right key.
"""

from __future__ import annotations

import difflib
import functools
import math
import re
import types
import typing
from pathlib import Path
from typing import Any, Iterator

from jsonargparse import ArgumentParser, Namespace, set_parsing_settings

from p2gs.types import UserError, short

Plain = dict[str, Any]
Keys = dict[str, Any]  # option names, nested as they are given; None: a single value
IT = "it"  # where jsonargparse keeps a class's options
WORDS = {int: "a whole number", float: "a number", str: "text", bool: "true or false", Path: "a path"}
# a config makes no object of a class that nothing asked for
set_parsing_settings(instantiate_subclass_spec_in_any=False)


def merge(base: Plain, over: Plain) -> Plain:
    """``over`` laid on ``base``: dicts merge key by key, anything else (null too) replaces. Neither is changed."""
    out = dict(base)
    for key, value in over.items():
        out[key] = merge(out[key], value) if isinstance(value, dict) and isinstance(out.get(key), dict) else value
    return out


def nested(path: str, value: Any) -> Plain:
    """``nested("a.b", 1) == {"a": {"b": 1}}``."""
    return functools.reduce(lambda inner, part: {part: inner}, reversed(path.split(".")), value)


@functools.cache
def _parser(cls: type) -> tuple[ArgumentParser, list[str], Namespace]:
    """What reads a class's options, the names of those without a default (None until given), and all defaults."""
    parser = ArgumentParser(exit_on_error=False, add_help=False)
    parser.add_class_arguments(cls, IT)
    needed = [action for action in parser._actions if action.required]
    for action in needed:
        action.required = False
    return parser, [action.dest.partition(".")[2] for action in needed], parser.get_defaults()


@functools.cache
def keys_of(cls: type) -> Keys:
    """The options of a dataclass, or the arguments of any other class's ``__init__``."""
    actions = _parser(cls)[0]._actions
    return functools.reduce(merge, (nested(action.dest, None) for action in actions), {}).get(IT) or {}


class Given:
    """Options of a class: those given, checked, and the defaults of the others. Raises UserError on a value of the
    wrong type.

    path: of the section in the config, with a dot at its end.  values: every option as YAML holds it.
    """

    def __init__(self, cls: type, tree: Plain, path: str = ""):
        self.cls, self.path = cls, path
        parser, _, defaults = _parser(cls)
        try:
            self._made = parser.parse_object({IT: _without_null(tree, keys_of(cls))}) if tree else defaults.clone()
        except Exception as err:  # told in several lines; the user gets one
            found = re.search(rf'"{IT}\.([\w.]+)"', str(err))
            raise self._wrong(found[1] if found else "", tree) from err
        self.values: Plain = plain(self._made.as_dict().get(IT) or {})
        for key, value in self._made.items():
            if any(isinstance(x, float) and math.isnan(x) for x in (value if isinstance(value, list) else [value])):
                raise self._wrong(key.partition(".")[2], tree)

    def _wrong(self, key: str, tree: Plain) -> UserError:
        value = functools.reduce(lambda at, name: at.get(name) if isinstance(at, dict) else at, key.split("."), tree)
        hints = {action.dest: getattr(action, "_typehint", None) for action in _parser(self.cls)[0]._actions}
        return UserError(f"{self.path}{key}: expected {describe(hints.get(f'{IT}.{key}'))}, got {short(value)}")

    def make(self) -> Any:
        """A new object of the class. Raises UserError where an option without a default is not given."""
        parser, needed, _ = _parser(self.cls)
        for name in needed:
            if self.values[name] is None:
                raise UserError(f"{self.path}{name} is not given (--{self.path}{name} VALUE)")
        return parser.instantiate(self._made.clone())[IT] if IT in self._made else self.cls()


def _without_null(tree: Any, keys: Keys) -> Plain:
    """The tree without groups of options that are null: these stay at their defaults."""
    kept = {name: value for name, value in tree.items() if value is not None or keys.get(name) is None}
    return {name: _without_null(value, keys[name] or {}) if keys.get(name) else value for name, value in kept.items()}


def plain(value: Any) -> Any:
    """The value as YAML holds it: dicts, lists, text, numbers."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return str(value) if isinstance(value, Path) else value


# -- mistakes, told in a sentence -------------------------------------------------------------------------------------


def check_keys(tree: Plain, keys: Keys, where: str = "") -> None:
    """Raise UserError at the first key that does not exist or is no section where one is needed. where: prefix of the
    message."""

    def check(tree: Plain, level: Keys, path: str) -> None:
        for name, value in tree.items():
            here = f"{path}{name}"
            if name not in level:
                raise UserError(f"{where}no option '{here}'{nearest(here, list(walk(keys)))}")
            if level[name] is not None and isinstance(value, dict):
                check(value, level[name], here + ".")
            elif level[name] is not None and value is not None:
                raise UserError(f"{where}{here}: expected options (key: value) or null, got {short(value)}")

    check(tree, keys, "")


def known_part(tree: Plain, keys: Keys, path: str = "") -> tuple[Plain, list[str]]:
    """The tree without keys that do not exist, and these, dotted."""
    kept, gone = {}, [path + name for name in tree if name not in keys]
    for name, value in tree.items():
        inner = keys.get(name)
        if inner is not None and isinstance(value, dict):
            kept[name], more = known_part(value, inner, f"{path}{name}.")
            gone += more
        elif name in keys:
            kept[name] = value
    return kept, gone


def walk(keys: Keys, prefix: str = "") -> Iterator[str]:
    """Every dotted key, sections included."""
    for name, inner in keys.items():
        yield prefix + name
        yield from walk(inner or {}, f"{prefix}{name}.")


def nearest(path: str, known: list[str]) -> str:
    """`` (did you mean 'x'?)``: of the keys whose last name is like this one's, the one that is likest as a whole; or
    the siblings."""
    parent, _, last = path.rpartition(".")
    names = difflib.get_close_matches(last, {k.rpartition(".")[2] for k in known}, n=9)
    alike = [k for k in known if k.rpartition(".")[2] in names]
    if alike:
        likeness = {k: sum(_ratio(*two) for two in ((last, k.rpartition(".")[2]), (path, k))) for k in alike}
        return f" (did you mean '{max(alike, key=likeness.__getitem__)}'?)"
    siblings = sorted(k.rpartition(".")[2] for k in known if k.rpartition(".")[0] == parent)
    return f"; known here: {', '.join(siblings)}" if siblings else ""


def _ratio(a: str, b: str) -> float:
    return difflib.SequenceMatcher(None, a, b).ratio()


def describe(hint: Any) -> str:
    """A type in words a user reads: ``a number``, ``one of a, b``, ``a whole number or null``."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, args))}" if args[1:] else "".join(f"'{a}'" for a in args)
    if origin in (typing.Union, types.UnionType):
        return " or ".join("null" if a is type(None) else describe(a) for a in args)
    if origin in (list, tuple):
        return f"a list like [{', '.join('...' if a is Ellipsis else describe(a) for a in args)}]"
    return WORDS.get(hint) or getattr(hint, "__name__", str(hint))
