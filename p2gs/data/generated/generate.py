"""Generated scenes on disk: made of a few arguments, with ground truth, and known again by them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Optional

from p2gs.data.generated.synthetic import make_object
from p2gs.data.generated.write import write_scene

GENERATOR = 1  # goes up when the same arguments give other pixels


def synthesize(
    out_dir,
    seed: int = 0,
    kind: Optional[str] = None,
    size: int = 400,
    train_views: int = 64,
    test_views: int = 10,
    format: Literal["artgs", "dta", "paris"] = "artgs",
    depth: bool = True,
) -> Path:
    """Generate a scene with ground truth and write it; returns its folder. seed: of the object and the cameras.

    kind: see ``make_object``; ``"demo"`` is the demo cabinet.  ``synthetic.json`` in the folder keeps these arguments.
    Raises UserError for an unknown kind or format, sizes that make no scene, and where ``out_dir`` already holds files.
    """
    arguments = recipe(seed, kind, size, train_views, test_views, format, depth)
    obj = make_object(kind, seed)
    return write_scene(obj, out_dir, format, size, train_views, test_views, seed, depth, recipe=arguments)


def recipe(
    seed: int,
    kind: Optional[str],
    size: int,
    train_views: int,
    test_views: int,
    format: str = "artgs",
    depth: bool = True,
) -> dict:
    """What ``synthetic.json`` holds: enough to make the same scene again."""
    return {
        "generator": GENERATOR,
        "kind": kind,
        "seed": seed,
        "size": size,
        "train_views": train_views,
        "test_views": test_views,
        "format": format,
        "depth": depth,
    }
