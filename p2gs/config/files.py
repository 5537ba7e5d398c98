"""Reading config files: where they are looked for, ``include``, strict YAML, command-line overrides."""

from __future__ import annotations

import functools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

import yaml

import p2gs
from p2gs.config.schema import Plain, merge, nested
from p2gs.registry import suggest
from p2gs.types import UserError, short

MAX_DEPTH = 20  # of a config; the deepest key of ours has 6 levels
MAX_VALUES = 10_000  # of a config, aliases counted as often as they stand for something; ours have some 400
# beside its own errors the loader lets those of a date, a number or a tag through that are none
UNREADABLE = (yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError, OverflowError, OSError)


@dataclass
class Layer:
    """One config file or the command line. where: what an error message starts with (``configs/x.yaml: ``)."""

    tree: Plain
    where: str = ""


class _StrictLoader(yaml.SafeLoader):
    """YAML where a key given twice is an error: the first one would be dropped without a word."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            key = self.construct_object(key_node, deep=True)
            wrong = "is no text" if not isinstance(key, (str, int, float)) else "is given twice" if key in seen else ""
            if wrong:
                raise yaml.constructor.ConstructorError(None, None, f"the key '{key}' {wrong}", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


def config_folders() -> list[Path]:
    """Folders of the configs that come with p2gs (installed package, or the source tree)."""
    package = Path(p2gs.__file__).parent
    return [folder for folder in (package / "configs", package.parent / "configs") if (folder / "base.yaml").is_file()]


def find_config(name: str, beside: Optional[Path] = None) -> Path:
    """The config file of that name: as given (relative to ``beside``), else among p2gs's own; ``.yaml`` may be left
    out."""
    given = Path(name)
    inner = Path(*given.parts[1:]) if given.parts[:1] == ("configs",) else given
    own = [] if given.is_absolute() else [folder / inner for folder in config_folders()]
    for path in (beside / given if beside else given, *own):
        for candidate in (path, path.with_name(path.name + ".yaml")) if path.name else ():
            try:
                if candidate.is_file():
                    return candidate
            except (OSError, ValueError):  # a name that no file can have
                continue
    known = sorted({str(p.relative_to(f).as_posix()) for f in config_folders() for p in f.rglob("*.yaml")})
    raise UserError(f"config file {short(name)} is not there{suggest(name[:200], known)}")


def read_config(
    name: str, beside: Optional[Path] = None, parents: tuple[Path, ...] = (), strict: bool = False
) -> list[Layer]:
    """The layers of a config file: what its ``include`` names first (relative to it), then itself.

    An include that leads out of the folder of the file that was named first, and is none of p2gs's own, is named before
    it is read; where ``strict`` (or the file says ``strict_paths: true``) it is refused with a UserError.
    """
    path = find_config(name, beside)
    if parents:
        _stay_inside(path, parents, strict)
    if path.resolve() in parents:
        raise UserError(f"{path}: includes itself")
    tree = read_yaml(path)
    includes = tree.pop("include", None) or []
    includes = [includes] if isinstance(includes, str) else includes
    if not isinstance(includes, list) or not all(isinstance(include, str) for include in includes):
        raise UserError(f"{path}: include: expected a file or a list of files, got {short(includes)}")
    inside = (path.parent, (*parents, path.resolve()), strict or tree.get("strict_paths") is True)
    return [*(layer for include in includes for layer in read_config(include, *inside)), Layer(tree, f"{path}: ")]


def read_yaml(path: Path) -> Plain:
    """A file's mapping. Raises UserError where it cannot be read, holds no mapping, or one that no config can be."""
    try:
        tree = yaml.load(path.read_text(encoding="utf-8"), Loader=_StrictLoader)
    except UNREADABLE as err:
        mark = getattr(err, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise UserError(f"{path}{line}: {getattr(err, 'problem', None) or str(err) or type(err).__name__}") from err
    tree = {} if tree is None else tree
    if not isinstance(tree, dict):
        raise UserError(f"{path}: expected a mapping (key: value), got {type(tree).__name__}")
    _check_tree(tree, f"{path}")
    return tree


def run_values(run_dir: Path | str) -> Plain:
    """RUN/config.yaml as plain values, {} where there is none. Raises UserError where that file is no config."""
    path = Path(run_dir) / "config.yaml"
    return read_yaml(path) if path.is_file() else {}


def _stay_inside(path: Path, parents: tuple[Path, ...], strict: bool) -> None:
    real = path.resolve()
    if any(real.is_relative_to(folder.resolve()) for folder in (parents[0].parent, *config_folders())):
        return
    sentence = f"{parents[-1]}: include: leads out of {parents[0].parent}, to {real}"
    if strict:
        raise UserError(f"{sentence}; refused, as strict_paths asks")
    print(f"note: {sentence}", file=sys.stderr, flush=True)


def _check_tree(tree: Plain, where: str) -> None:
    """Raise UserError where a config is deeper or larger than any can be: aliases make a few lines endless, and what
    reads them hangs."""
    count, todo = 0, [(tree, 0)]
    while todo:
        value, depth = todo.pop()
        count += 1
        if depth > MAX_DEPTH or count > MAX_VALUES:
            raise UserError(f"{where}: is no config: more than {MAX_DEPTH} levels or {MAX_VALUES} values")
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple, set)) else ()
        todo += [(item, depth + 1) for item in inner]


def parse_overrides(words: list[str]) -> list[tuple[str, Any]]:
    """``--a.b 1 --c=x`` -> ``[("a.b", "1"), ("c", "x")]``. Values stay text, but null, [lists] and {mappings} are read
    as YAML.

    Raises UserError where a value is missing or a word belongs to no option.
    """
    out, rest = [], iter(words)
    for word in rest:
        if not word.startswith("--") or len(word) < 3:
            raise UserError(
                f"'{word}' belongs to no option (single values are given as --key value, config files as -c FILE)"
            )
        key, equals, value = word[2:].partition("=")
        value = value if equals else next(rest, "--none")
        if not equals and value.startswith("--") and len(value) > 2:
            raise UserError(f"--{key} needs a value")
        out.append((key, _read_value(key, value)))
    return out


def _read_value(key: str, text: str) -> Any:
    if text.strip() not in ("null", "~") and text.strip()[:1] not in ("{", "["):
        return text
    try:
        value = yaml.load(text, Loader=_StrictLoader)
    except UNREADABLE as err:
        raise UserError(f"--{key}: {short(text)} cannot be read ({getattr(err, 'problem', err)})") from err
    _check_tree({key: value}, f"--{key}")
    return value


def overrides_layer(overrides: list[tuple[str, Any]]) -> Layer:
    """Single options as a layer of their own."""
    return Layer(functools.reduce(merge, (nested(key, value) for key, value in overrides), {}))


class _Dumper(yaml.SafeDumper):
    """Lists on one line, nothing by reference."""

    def ignore_aliases(self, data):
        return True


_Dumper.add_representer(list, lambda d, data: d.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True))


def to_yaml(tree: Plain) -> str:
    return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, default_flow_style=False, allow_unicode=True, width=140)
