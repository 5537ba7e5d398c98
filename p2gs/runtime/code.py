"""A fingerprint of the code that makes a result: the syntax trees of a module and of all that it imports of its own package.

Comments, docstrings and layout do not count. A tree is as its source, so trees' fingerprints are kept by the source's hash.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import json
import os
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Iterable, Optional

COMMENTS = re.compile(rb"//[^\n]*|/\*.*?\*/", re.S)  # of C++; a string that looks like one changes nothing but the fingerprint's grain
NATIVE = "p2gs.native"


@dataclass(frozen=True)
class Source:
    """tree: hash of a file's syntax tree.  imports: dotted names it imports, those inside functions too; of ``from a import b`` a.b."""

    tree: str
    imports: tuple[str, ...]


def code_of(modules: Iterable[str]) -> dict[str, str]:
    """Module -> hash for the given modules and all modules of the same top-level packages that they import, directly or not.

    A plugin's module counts with those that lie beside it. A parent package's ``__init__`` counts only where it is imported itself.
    Modules without source (built interactively) are left out.
    """
    found: dict[str, str] = {}
    todo = list(modules)
    with _cache() as sources:
        while todo:
            name = todo.pop()
            path = None if name in found else module_file(name)
            if path is None:
                continue
            source = sources.of(path)
            found[name] = source.tree
            roots = {name.split(".")[0], "p2gs"}
            for target in source.imports:
                todo += [t for t in (target, target.rpartition(".")[0]) if t and (t.split(".")[0] in roots or _beside(t, path))]
    if NATIVE in found:
        found["native kernels"] = native_code()
    return found


def module_file(name: str) -> Optional[Path]:
    """The source file of a module; None for what is no module, or has none."""
    module = sys.modules.get(name)
    origin = getattr(module, "__file__", None)
    if module is None:
        parent = name.rpartition(".")[0]
        if parent and module_file(parent) is None:
            return None
        origin = _origin(name)
    return Path(origin) if origin and origin.endswith(".py") else None


@functools.cache
def _origin(name: str) -> Optional[str]:
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, AttributeError, ValueError):  # a.b where a is no package
        return None
    return spec.origin if spec else None


def _beside(name: str, path: Path) -> bool:
    """Whether the top of a dotted name is a file or package in the folder of ``path``, outside of installed packages."""
    top = path.parent / name.split(".")[0]
    return "site-packages" not in path.parts and (top.with_suffix(".py").is_file() or (top / "__init__.py").is_file())


def read_source(text: bytes) -> Source:
    """Raises SyntaxError."""
    tree = ast.parse(text)
    imports: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            imports |= {f"{node.module}.{alias.name}" for alias in node.names}
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and ast.get_docstring(node, False) is not None:
            node.body = node.body[1:]
    return Source(_digest(ast.dump(tree).encode()), tuple(sorted(imports)))


@functools.cache
def native_code() -> str:
    """Hash of the kernels: their sources without comments where they are there, else the built extension."""
    import p2gs.native

    folder = Path(p2gs.native.__file__).parent
    files = sorted(p for p in folder.iterdir() if p.suffix in (".cpp", ".h", ".inc"))
    if files:
        return _digest(b"".join(p.name.encode() + b"".join(COMMENTS.sub(b"", p.read_bytes()).split()) for p in files))
    built = getattr(p2gs.native.native, "__file__", None)
    return _digest(Path(built).read_bytes()) if built else "none"


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


class _cache:
    """Fingerprints by the hash of their source, kept between processes in the user's cache folder where there is one to write to."""

    _known: dict[str, Source] = {}  # of this process
    _read = False

    def __enter__(self) -> "_cache":
        self.new = False
        if not _cache._read:
            _cache._read = True
            try:
                stored = json.loads(self.path().read_text())
                _cache._known |= {k: Source(v[0], tuple(v[1])) for k, v in stored.items()}
            except (OSError, ValueError, TypeError, IndexError):  # not there, or damaged: made again
                pass
        return self

    def of(self, path: Path) -> Source:
        text = path.read_bytes()
        key = f"{sys.version_info[0]}.{sys.version_info[1]}-{hashlib.sha256(text).hexdigest()[:32]}"
        if key not in self._known:
            try:
                self._known[key] = read_source(text)
            except SyntaxError:  # written for another Python, so never imported: as it is
                self._known[key] = Source(_digest(text), ())
            self.new = True
        return self._known[key]

    def __exit__(self, *exc) -> None:
        if not self.new or exc[0] is not None:
            return
        try:
            self.path().parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile("w", dir=self.path().parent, delete=False) as file:
                json.dump({k: [s.tree, s.imports] for k, s in list(self._known.items())[-2000:]}, file)
            os.replace(file.name, self.path())
        except OSError:  # no home to write to: made again next time
            pass

    @staticmethod
    def path() -> Path:
        home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
        return Path(home) / "p2gs" / "code.json"
