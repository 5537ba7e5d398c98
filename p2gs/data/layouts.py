"""The layouts that scenes are published in, by name. A layout is a module with ``detect``, ``index`` and
``ground_truth_folder``."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Optional

from p2gs.data import artgs, dta, paris
from p2gs.types import UserError

LAYOUTS: dict[str, ModuleType] = {"artgs": artgs, "dta": dta, "paris": paris}


def detect_format(root: Path) -> Optional[str]:
    """The name of the layout that the folder looks like, or None."""
    return next((name for name, layout in LAYOUTS.items() if layout.detect(root)), None)


def layout_named(name: str) -> ModuleType:
    """Raises UserError for an unknown name."""
    from p2gs.registry import suggest

    if name == "synthetic":
        return artgs  # generated scenes are written in the ArtGS layout
    if name not in LAYOUTS:
        raise UserError(f"unknown data format '{name}'{suggest(name, LAYOUTS)}")
    return LAYOUTS[name]
