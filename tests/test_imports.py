"""The house rules that a reader relies on: imports point one way, an optional dependency lives in one file, help needs
no torch."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "p2gs"

# what is imported stands in an earlier row, or in the same one
ORDER = [
    ("types", "registry", "stage_times", "machine", "stopping", "run_lock"),
    ("provenance", "config.schema", "config.files"),
    ("ops", "native"),
    ("render",),
    ("losses", "metrics", "data"),
    ("context", "gaussians"),
    ("visibility",),
    ("motion",),
    ("parts",),
    ("surface",),
    ("models",),
    ("export", "callbacks"),
    ("diagnosis",),
    ("config",),
    ("scores",),
    ("runtime", "bench"),
    ("commands", "app"),
    ("cli", "__main__"),
]
RANK = {name: row for row, names in enumerate(ORDER) for name in names}
APART = [
    ("losses", "metrics"),
    ("losses", "data"),
    ("metrics", "losses"),
    ("metrics", "data"),
    ("data", "losses"),
    ("data", "metrics"),
]
OPTIONAL = [
    "gsplat",
    "viser",
    "imageio_ffmpeg",
    "pxr",
    "mujoco",
    "yourdfpy",
    "embreex",
    "mitsuba",
    "hypothesis",
    "matplotlib",
    "submitit",
    "ray",
    "pycolmap",
    "pillow_heif",
]


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


@functools.cache
def imports(path: Path) -> set[str]:
    """Every module imported anywhere in a file, those inside functions too, by full name."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import; the house writes full names"
            found.add(node.module)
            if node.module == "p2gs":
                found |= {f"p2gs.{alias.name}" for alias in node.names if alias.name in RANK}
    return found


def house_imports():
    for name, path in modules():
        if name == "p2gs":
            continue
        for target in imports(path):
            if target.startswith("p2gs."):
                yield name, target


def rank(module: str) -> int:
    """The row of a module: its own, or its room's."""
    parts = module.split(".")[1:]
    return RANK.get(".".join(parts[:2]), RANK.get(parts[0], -1))


def test_every_module_has_a_place_in_the_order():
    assert {name.split(".")[1] for name, _ in modules() if name != "p2gs"} <= set(RANK)


def test_imports_point_one_way():
    wrong = []
    for name, target in house_imports():
        if rank(target) > rank(name):
            wrong.append(f"{name} imports {target}")
    assert not wrong, wrong


def test_there_are_no_cycles():
    """No module imports itself through others, not even inside a function: each can be read, tested and moved without
    the next."""
    graph: dict[str, set[str]] = {name: set() for name, _ in modules()}
    for name, path in modules():
        for target in names_imported(path):
            found = target if target in graph else target.rpartition(".")[0]
            if found in graph and found != name:
                graph[name].add(found)
    around = sorted(name for name in graph if name in reachable(graph, name))
    assert not around, around


def test_the_docs_draw_these_imports():
    """Between rooms, by a reader of its own, which finds no circle either."""
    page = (PACKAGE.parent / "docs" / "house.md").read_text(encoding="utf-8")
    drawn = subprocess.run(
        [sys.executable, PACKAGE.parent / "bench" / "draw_imports.py"], capture_output=True, text=True, timeout=60
    )
    assert drawn.returncode == 0, drawn.stderr
    told = "docs/house.md: python bench/draw_imports.py draws it anew"
    assert page.split("```mermaid\n")[1].split("```")[0] == drawn.stdout, told


def names_imported(path: Path):
    """Dotted names a file imports; of ``from a import b`` a.b."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    seen: set[str] = set()
    todo = list(graph[start])
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            todo += graph[name]
    return seen


def test_losses_metrics_and_data_do_not_know_each_other():
    assert not [f"{a} imports {b}" for a, b in house_imports() if (a.split(".")[1], b.split(".")[1]) in APART]


def test_ground_truth_is_opened_for_scoring_only():
    """No training code reads ground truth: the evaluation command and callback do, and the dataset check and writer."""
    readers = {a for a, b in house_imports() if b == "p2gs.data.ground_truth"}
    allowed = ("p2gs.scores.", "p2gs.callbacks.evaluation", "p2gs.data.", "p2gs.bench.")
    assert not [r for r in readers if not r.startswith(allowed)], readers
    assert not readers & {"p2gs.data.base", "p2gs.data.modules", "p2gs.data.images", "p2gs.data.views"}


@pytest.mark.parametrize("dependency", OPTIONAL)
def test_an_optional_dependency_is_imported_in_one_file(dependency):
    users = [name for name, path in modules() if any(t.split(".")[0] == dependency for t in imports(path))]
    assert len(users) <= 1, users


def test_no_import_of_what_breaks_lightning():
    """torchvision, lpips: a build that does not match torch's breaks Lightning's imports. open3d, pytorch3d, plyfile
    (GPL): by design."""
    banned = {"torchvision", "lpips", "open3d", "pytorch3d", "plyfile"}
    assert not [name for name, path in modules() if {t.split(".")[0] for t in imports(path)} & banned]


def test_the_registries_import_without_heavy_libraries():
    """What every `p2gs fit` waits for: no mesh, image or plotting library before it is needed."""
    code = """
import sys
from p2gs.config.run import import_builtins
import_builtins()
heavy = {"trimesh", "skimage", "cv2", "viser", "gsplat"} & set(sys.modules)
print(sorted(heavy))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
