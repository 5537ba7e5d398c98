"""Which room of the house imports which, as the drawing in docs/house.md.

    python bench/draw_imports.py

Prints a Mermaid flow chart: an arrow goes from a room to a room below it that imports it, but where a longer way of
arrows says so already. Raises UserError where rooms import each other in a circle: then there is no such drawing.
"""

from __future__ import annotations

import ast
from pathlib import Path

from p2gs.types import UserError

PACKAGE = Path(__file__).parents[1] / "p2gs"
BASIS = ("types", "registry", "stage_times", "machine", "stopping", "run_lock", "provenance")
READERS = ("config.schema", "config.files")  # of YAML: they know no option, so who reads a config may import them
COMMAND_LINE = ("app", "commands", "cli", "__main__")


def room(module: str) -> str:
    """The room of a module named without ``p2gs.``."""
    first = module.split(".")[0]
    if module in READERS:
        return "config files"
    return "types, registry" if first in BASIS else "command line" if first in COMMAND_LINE else first


def edges() -> set[tuple[str, str]]:
    """(room, room that it imports), imports inside functions too."""
    found = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if name != "__init__" else ():
            if isinstance(node, ast.ImportFrom) and node.module == "p2gs":
                targets = [alias.name for alias in node.names if (PACKAGE / f"{alias.name}.py").is_file()]
            elif isinstance(node, ast.ImportFrom):
                targets = [(node.module or "").removeprefix("p2gs.")] if (node.module or "").startswith("p2gs.") else []
            else:
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                targets = [n.removeprefix("p2gs.") for n in names if n.startswith("p2gs.")]
            found |= {(room(name), room(target)) for target in targets}
    return {(a, b) for a, b in found if a != b}


def reached(graph: set[tuple[str, str]], start: str) -> set[str]:
    """Every room that ``start`` imports, through others too."""
    seen: set[str] = set()
    todo = [b for a, b in graph if a == start]
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            todo += [b for a, b in graph if a == name]
    return seen


def drawing() -> str:
    """The flow chart. Raises UserError where there is a circle."""
    graph = edges()
    below = {name: reached(graph, name) for pair in graph for name in pair}
    around = sorted(name for name, rooms in below.items() if name in rooms)
    if around:
        raise UserError(f"imports go in a circle through {', '.join(around)}")
    short = {(a, b) for a, b in graph if not any(b in below[c] for x, c in graph if x == a)}
    order = sorted(below, key=lambda name: (len(below[name]), name))
    number = {name: f"r{i}" for i, name in enumerate(order)}
    lines = [f"    {number[name]}[{name}]" for name in order]
    arrows = sorted(short, key=lambda pair: (order.index(pair[0]), order.index(pair[1])))
    return "\n".join(["flowchart TD", *lines, *(f"    {number[b]} --> {number[a]}" for a, b in arrows)])


if __name__ == "__main__":
    print(drawing())
