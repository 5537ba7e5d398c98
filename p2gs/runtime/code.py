"""A fingerprint of the code that makes a result: the syntax trees of a module and of all that it imports of its own
package.

Comments, docstrings and layout do not count. A tree is as its source, so trees' fingerprints are kept by the source's
hash.
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

COMMENTS = re.compile(rb"//[^\n]*|/\*.*?\*/", re.S)  # of C++, where no string holds what looks like one
NATIVE = "p2gs.native"
MOST_KEPT = 2000  # sources in the cache


@dataclass(frozen=True)
class Source:
    """tree: hash of a file's syntax tree.  imports: dotted names it imports, those inside functions too; of ``from a
    import b`` a.b."""

    tree: str
    imports: tuple[str, ...]


class CodeReader:
    """Reads each source file once; what has been read before by any run comes from the user's cache folder, where there
    is one."""

    def __init__(self) -> None:
        self.sources: dict[str, Optional[Source]] = {}  # by module
        self.cache = TreeCache()

    def code_of(self, modules: Iterable[str]) -> dict[str, str]:
        """Module -> hash for the given modules and all modules of the same top-level packages that they import,
        directly or not.

        A plugin's module counts with those that lie beside it. A parent package's ``__init__`` counts only where it is
        imported itself. Modules without source (built interactively) are left out.
        """
        found: dict[str, str] = {}
        todo = list(modules)
        while todo:
            name = todo.pop()
            source = None if name in found else self.source(name)
            if source is not None:
                found[name] = source.tree
                todo += source.imports
        self.cache.save()
        if NATIVE in found:
            found["native kernels"] = native_code()
        return found

    def source(self, name: str) -> Optional[Source]:
        """Of a module, its imports narrowed to modules of the same package, of p2gs, or beside it; None where it has no
        source."""
        if name not in self.sources:
            path, source = module_file(name), None
            if path is not None:
                source = self.cache.of(path)
                roots = {name.split(".")[0], "p2gs"}
                names = {t for target in source.imports for t in (target, target.rpartition(".")[0]) if t}
                near = tuple(sorted(t for t in names if t.split(".")[0] in roots or _beside(t, path)))
                source = Source(source.tree, near)
            self.sources[name] = source
        return self.sources[name]


def module_file(name: str) -> Optional[Path]:
    """The source file of a module, found without importing it; None for what is no module, or has none."""
    if name in sys.modules:
        origin = getattr(sys.modules[name], "__file__", None)
        return Path(origin) if origin and origin.endswith(".py") else None
    parent, _, last = name.rpartition(".")
    if not parent:
        try:
            spec = importlib.util.find_spec(name)
        except (ImportError, ValueError):
            return None
        return Path(spec.origin) if spec and spec.origin and spec.origin.endswith(".py") else None
    package = module_file(parent)
    if package is None or package.name != "__init__.py":
        return None
    files = (package.parent / f"{last}.py", package.parent / last / "__init__.py")
    return next((file for file in files if file.is_file()), None)


def _beside(name: str, path: Path) -> bool:
    """Whether the top of a dotted name is a file or package in the folder of ``path``, outside of installed
    packages."""
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
        if (
            isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
            and ast.get_docstring(node, False) is not None
        ):
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


class TreeCache:
    """Fingerprints by the hash of their source, kept between processes; damaged or unwritable, they are made again."""

    def __init__(self) -> None:
        home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
        self.path, self.new = Path(home) / "p2gs" / "code.json", False
        try:
            self.known = {k: Source(v[0], tuple(v[1])) for k, v in json.loads(self.path.read_text()).items()}
        except (OSError, ValueError, TypeError, IndexError, AttributeError):
            self.known = {}

    def of(self, path: Path) -> Source:
        text = path.read_bytes()
        key = f"{sys.version_info[0]}.{sys.version_info[1]}-{hashlib.sha256(text).hexdigest()[:32]}"
        if key not in self.known:
            try:
                self.known[key] = read_source(text)
            except SyntaxError:  # written for another Python, so never imported: as it is
                self.known[key] = Source(_digest(text), ())
            self.new = True
        return self.known[key]

    def save(self) -> None:
        if not self.new:
            return
        self.new = False
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile("w", dir=self.path.parent, delete=False) as file:
                json.dump({k: [s.tree, s.imports] for k, s in list(self.known.items())[-MOST_KEPT:]}, file)
            os.replace(file.name, self.path)
        except OSError:
            pass
