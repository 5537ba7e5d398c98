"""Console entry points. Standard library only, so that ``p2gs --help`` answers at once; the heavy part is imported by
``app`` when a command runs.
"""

from __future__ import annotations

import os
import sys
from typing import Optional, Sequence

SDK = "lightning-sdk"


def main(argv: Optional[Sequence[str]] = None, prog: str = "p2gs") -> int:
    """``p2gs WORDS``. Returns the exit code: 0, 1 (the work failed), 2 (a mistake in the command or its input), 130
    (interrupted)."""
    # torch's idle threads would spin on cores that the kernels want
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from p2gs.app import run

    return run(list(sys.argv[1:] if argv is None else argv), prog)


def lightning_main(argv: Optional[Sequence[str]] = None) -> int:
    """``lightning WORDS``: p2gs's own commands under Lightning's name; what is not ours goes on to lightning-sdk, who
    owns the name too."""
    words = list(sys.argv[1:] if argv is None else argv)
    from p2gs.app import COMMANDS

    if not words or words[0].startswith("-") or words[0] in COMMANDS:
        return main(words, "lightning")
    owner = _sdk_entry_point()
    if owner is None:
        known = ", ".join(COMMANDS)
        message = (
            f"'{words[0]}' is no command of p2gs ({known}), and {SDK}, whose 'lightning' might know it, is not "
            "installed"
        )
        print(f"error: {message}", file=sys.stderr)
        return 2
    sys.argv = ["lightning", *words]
    return owner.load()() or 0


def _sdk_entry_point():
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        points = distribution(SDK).entry_points
    except PackageNotFoundError:
        return None
    return next((p for p in points if p.group == "console_scripts" and p.name in (SDK, "lightning")), None)


if __name__ == "__main__":
    sys.exit(main())
