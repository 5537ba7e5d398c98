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


def format_of(root: Path) -> str:
    """The layout of the folder given as data.root where no data.format is. Raises UserError where it is none, or there
    is no such folder."""
    try:
        present = root.is_dir()
    except (OSError, ValueError):  # a name that no folder can have
        present = False
    if not present:
        raise UserError(f"data.root: the folder {str(root)[:300]} is not there")
    found = detect_format(root)
    if found is None:
        known = ", ".join(LAYOUTS)
        raise UserError(
            f"data.format is not given, and {root} looks like none of the layouts {known}; give --data.format NAME"
        )
    return found


def layout_named(name: str) -> ModuleType:
    """Raises UserError for an unknown name."""
    from p2gs.registry import suggest

    if name == "synthetic":
        return artgs  # generated scenes are written in the ArtGS layout
    if name not in LAYOUTS:
        raise UserError(f"unknown data format '{name}'{suggest(name, LAYOUTS)}")
    return LAYOUTS[name]
