"""The native kernels, or the reason why they are missing.

``native`` is the extension module ``p2gs._native`` or None; ``why_missing`` then says why in one sentence.
"""

from __future__ import annotations

import os
import warnings
from typing import Optional

from p2gs.types import UserError

why_missing: Optional[str] = None

try:
    from p2gs import _native as native
except ImportError as err:
    native = None
    if getattr(err, "name", None) == "p2gs._native" or "cannot import name" in str(err):
        why_missing = "p2gs was installed without its native kernels (no C++ compiler was found)"
    else:
        why_missing = f"the native kernels cannot be loaded: {err}"

if native is not None:
    _wanted = os.environ.get("P2GS_ISA")
    if _wanted and _wanted not in native.available_isas():
        raise UserError(f"P2GS_ISA={_wanted} is not among what this machine runs: {', '.join(native.available_isas())}")


def num_threads() -> int:
    """Threads a kernel may use: those of torch (``torch.set_num_threads``, ``OMP_NUM_THREADS``)."""
    import torch

    return torch.get_num_threads()


def keep_memory() -> None:
    """For a process that trains: malloc keeps what a step frees for the next one (up to 1 GiB), which saves the page faults.

    For the whole process, and for good; only with glibc. Importing p2gs does not do it, ``p2gs fit`` does.
    """
    if native is not None:
        native.keep_memory()


_warned = False


def warn_missing_once() -> None:
    """Say once in a process that the slow reference implementations are used, and what to do about it."""
    global _warned
    if native is None and not _warned:
        _warned = True
        warnings.warn(
            f"{why_missing}: using the reference rasterizer in torch, about 100 times slower on a CPU. "
            "Install a C++ compiler and reinstall p2gs to get the fast one.",
            stacklevel=2,
        )
