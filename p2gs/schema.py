"""Typed config sections built from classes: which keys there are, what type a value must have, how the object is made.

A dataclass is a section, each of its fields a key; a field of type ``Optional[<dataclass>]`` is a section that ``null`` switches
off. Values are checked by jsonargparse, one at a time, so that a mistake is told in one line. Merging is ours, on plain dicts:
jsonargparse (hence LightningCLI) replaces a ``dict[str, Loss]`` as a whole where it should merge, without a word.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import math
import types
import typing
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, Callable, Iterable, Iterator, Union

from p2gs.types import UserError, short

Plain = dict[str, Any]


@dataclass
class Leaf:
    """A single value. ``default`` is MISSING where the user has to give one."""

    type: Any
    default: Any = MISSING


@dataclass
class Section:
    """A group of keys that becomes ``make(**values)``. optional: null switches it off.  on: whether it is on when not mentioned."""

    make: Callable
    children: dict[str, Union["Section", Leaf]] = field(default_factory=dict)
    optional: bool = False
    on: bool = True

    def walk(self, prefix: str = "") -> Iterator[str]:
        """Every dotted key below, sections included."""
        for name, child in self.children.items():
            yield prefix + name
            if isinstance(child, Section):
                yield from child.walk(f"{prefix}{name}.")


def section_of(cls: Callable, default: Any = MISSING) -> Section:
    """The section of a dataclass, or of the ``__init__`` arguments of any other class (every argument needs a type)."""
    section = Section(cls)
    for name, hint, value in _dataclass_fields(cls, default) if dataclasses.is_dataclass(cls) else _init_arguments(cls):
        inner, optional = _without_none(hint)
        if dataclasses.is_dataclass(inner) and isinstance(inner, type):
            child = section_of(inner, value if value is not MISSING and value is not None else MISSING)
            child.optional, child.on = optional, not (optional and value is None)
            section.children[name] = child
        else:
            section.children[name] = Leaf(hint, value)
    return section


def _dataclass_fields(cls, instance):
    hints = typing.get_type_hints(cls)
    for f in dataclasses.fields(cls):
        if not f.init:
            continue
        if instance is not MISSING:
            value = getattr(instance, f.name)
        else:
            value = f.default_factory() if f.default_factory is not MISSING else f.default
        yield f.name, hints[f.name], value


def _init_arguments(cls):
    hints = typing.get_type_hints(cls.__init__)
    for name, parameter in list(inspect.signature(cls.__init__).parameters.items())[1:]:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        if name not in hints:
            raise TypeError(f"{cls.__qualname__}.__init__: argument '{name}' needs a type annotation to be settable from the config")
        yield name, hints[name], MISSING if parameter.default is parameter.empty else parameter.default


def _without_none(hint) -> tuple[Any, bool]:
    if typing.get_origin(hint) in (Union, types.UnionType):
        rest = [a for a in typing.get_args(hint) if a is not type(None)]
        if len(rest) == 1 and len(typing.get_args(hint)) == 2:
            return rest[0], True
    return hint, False


# -- merging -----------------------------------------------------------------------------------------------------------------------


def merge(base: Plain, over: Plain) -> Plain:
    """``over`` laid on ``base``: dicts merge key by key, anything else (null too) replaces. Neither argument is changed."""
    out = dict(base)
    for key, value in over.items():
        out[key] = merge(out[key], value) if isinstance(value, dict) and isinstance(out.get(key), dict) else value
    return out


def nested(path: str, value: Any) -> Plain:
    """``nested("a.b", 1) == {"a": {"b": 1}}``."""
    for part in reversed(path.split(".")):
        value = {part: value}
    return value


# -- checking ----------------------------------------------------------------------------------------------------------------------


def check_keys(tree: Plain, section: Section, where: str = "") -> None:
    """Raise UserError at the first key that does not exist or is no section where one is needed. where: prefix of the message."""
    _check_keys(tree, section, "", where, list(section.walk()))


def _check_keys(tree: Plain, section: Section, prefix: str, where: str, known: list[str]) -> None:
    for key, value in tree.items():
        path = f"{prefix}{key}"
        child = section.children.get(key)
        if child is None:
            raise UserError(f"{where}no option '{path}'{nearest(path, known)}")
        if isinstance(child, Section):
            if isinstance(value, dict):
                _check_keys(value, child, path + ".", where, known)
            elif value is not None:
                null = " or null" if child.optional else ""
                raise UserError(f"{where}{path}: expected options (key: value){null}, got {short(value)}")


def nearest(path: str, known: list[str]) -> str:
    """`` (did you mean 'x'?)``: the key that ends so, a sibling like it, its name elsewhere, a name like it elsewhere; or the siblings."""
    parent, _, last = path.rpartition(".")
    siblings = {k.rpartition(".")[2]: k for k in known if k.rpartition(".")[0] == parent}
    names = {k.rpartition(".")[2] for k in known}

    def alike(candidates, cutoff: float) -> list[str]:
        return difflib.get_close_matches(last, candidates, n=1, cutoff=cutoff)

    options = (
        [k for k in known if k.endswith("." + path)]
        or [siblings[n] for n in alike(siblings, 0.6)]
        or [k for k in known if k.rpartition(".")[2] == last]
        or [k for n in alike(names, 0.75) for k in known if k.rpartition(".")[2] == n]
    )
    if options:
        best = max(options, key=lambda k: difflib.SequenceMatcher(None, path, k).ratio())
        return f" (did you mean '{best}'?)"
    return f"; known here: {', '.join(sorted(siblings))}" if siblings else ""


def complete(tree: Plain, section: Section, prefix: str = "") -> Plain:
    """All keys of the section with typed values: given ones checked, the others at their defaults, sections that are off None.

    A required value that is missing stays ``dataclasses.MISSING`` (``build`` complains). Raises UserError on a wrong type.
    """
    out: Plain = {}
    for name, child in section.children.items():
        path = prefix + name
        if isinstance(child, Leaf):
            out[name] = typed(tree[name], child.type, path) if name in tree else child.default
        elif tree.get(name) is not None:
            out[name] = complete(tree[name], child, path + ".")
        elif child.optional and (name in tree or not child.on):
            out[name] = None
        else:
            out[name] = complete({}, child, path + ".")
    return out


def build(values: Plain, section: Section, prefix: str = "") -> Any:
    """The object of a completed section. Raises UserError where a required value is missing."""
    made = {}
    for name, value in values.items():
        child = section.children[name]
        if value is MISSING:
            raise UserError(f"{prefix}{name} is not given (--{prefix}{name} VALUE)")
        made[name] = build(value, child, f"{prefix}{name}.") if isinstance(child, Section) and value is not None else value
    return section.make(**made)


@functools.cache
def _parser(hint):
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--value", type=hint)
    return parser


def typed(value: Any, hint: Any, path: str) -> Any:
    """``value`` as ``hint`` demands (text is read as the command line would give it). Raises UserError naming ``path``."""
    parser = _parser(hint)
    try:
        made = parser.parse_object({"value": value}, defaults=False).value
    except Exception as err:  # jsonargparse reports in several lines; the user gets one
        raise UserError(f"{path}: expected {describe(hint)}, got {short(value)}") from err
    if any(isinstance(x, float) and math.isnan(x) for x in (made if isinstance(made, list) else [made])):
        raise UserError(f"{path}: expected {describe(hint)}, got {short(value)}")
    return made


def describe(hint: Any) -> str:
    """A type in words a user reads: ``a number``, ``one of a, b``, ``a whole number or null``."""
    words = {int: "a whole number", float: "a number", str: "text", bool: "true or false", type(None): "null", Path: "a path"}
    if hint in words:
        return words[hint]
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, args))}" if len(args) > 1 else f"'{args[0]}'"
    if origin in (Union, types.UnionType):
        return " or ".join(describe(a) for a in args)
    if origin in (list, tuple):
        return f"a list like [{', '.join(describe(a) if a is not Ellipsis else '...' for a in args)}]"
    return getattr(hint, "__name__", str(hint))


def plain(value: Any) -> Any:
    """The value as YAML holds it: dicts, lists, text, numbers. A missing required value becomes null."""
    if value is MISSING:
        return None
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def switches(classes: Iterable[tuple[str, type]]) -> Section:
    """A section with one optional section a name, all off unless mentioned; it becomes a dict of those that are on."""
    section = Section(lambda **made: {name: item for name, item in made.items() if item is not None})
    for name, cls in classes:
        section.children[name] = section_of(cls)
        section.children[name].optional, section.children[name].on = True, False
    return section
