"""What made a file of results: version, git commit and command line."""

from __future__ import annotations

import shlex
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Optional

import p2gs


def provenance() -> dict[str, Any]:
    """Version, git commit (null when not run from a git checkout) and command line of this run."""
    try:
        number = version("p2gs")
    except PackageNotFoundError:
        number = None
    return {"version": number, "git": _git_commit(), "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])}


def _git_commit() -> Optional[str]:
    package = Path(p2gs.__file__).parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(package), *words], capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != package.parent.resolve():
            return None  # installed inside somebody else's repository
        return git("rev-parse", "HEAD") + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None
