"""Name-keyed registries: a loss, callback, phase, dataset or rasterizer is found by the name it was registered
under."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from typing import Callable, Generic, Iterator, TypeVar

from p2gs.types import UserError, short

T = TypeVar("T")


class Registry(Generic[T]):
    """Names to classes (or functions). A name can be given once; a wrong name is answered with the nearest right
    one."""

    def __init__(self, kind: str):
        self.kind = kind
        self._items: dict[str, T] = {}
        self.paths: dict[str, str] = {}  # name -> class_path of what a config named by it

    def register(self, name: str) -> Callable[[T], T]:
        """Decorator. Raises ValueError when the name is taken by something else."""

        def wrap(item: T) -> T:
            old = self._items.get(name)
            if old is not None and getattr(old, "__qualname__", old) != getattr(item, "__qualname__", item):
                raise ValueError(f"{self.kind} '{name}' is already registered by {old!r}")
            self._items[name] = item
            return item

        return wrap

    def put(self, name: str, item: T, path: str) -> None:
        """Register what a config names by ``class_path``, in place of what it named so before."""
        self._items[name], self.paths[name] = item, path

    def __getitem__(self, name: str) -> T:
        if name not in self._items:
            raise UserError(f"unknown {self.kind} '{name}'{suggest(name, self._items)}")
        return self._items[name]

    def __contains__(self, name: object) -> bool:
        return name in self._items

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def items(self):
        return self._items.items()


def suggest(name: str, known) -> str:
    """`` (did you mean 'x'?)`` or the list of known names."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f" (did you mean '{close[0]}'?)"
    return f"; known: {', '.join(known)}" if known else ""


def load_plugins(modules: tuple[str, ...] = ()) -> None:
    """Import the user's modules, then those of the entry-point group ``p2gs.plugins`` and of ``P2GS_PLUGINS``
    (comma-separated).

    The working directory is importable, as ``python -c`` would have it. Raises UserError when a module cannot be
    imported.
    """
    from importlib.metadata import entry_points

    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    names = [*modules, *filter(None, os.environ.get("P2GS_PLUGINS", "").split(","))]
    for name in names:
        module = name.removesuffix(".py").replace("/", ".")
        if not all(part.isidentifier() for part in module.split(".")):
            raise UserError(f"plugin {short(name)}: expected the name of a module, like my_losses")
        try:
            importlib.import_module(module)
        except ImportError as err:
            raise UserError(f"plugin '{name}' cannot be imported: {err}") from err
    for point in entry_points(group="p2gs.plugins"):
        try:
            point.load()
        except Exception as err:  # a broken third-party plugin must name itself
            raise UserError(f"plugin entry point '{point.name}' ({point.value}) failed: {err}") from err
