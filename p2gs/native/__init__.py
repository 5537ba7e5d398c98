"""The native kernels, or the reason why they are missing.

``native`` is the extension module ``p2gs._native`` or None; ``why_missing`` then says why in one sentence.
"""

from __future__ import annotations

import os
import warnings
from contextlib import contextmanager
from typing import Any, Iterator, Optional

from p2gs.types import UserError

why_missing: Optional[str] = None

native: Any = None

try:
    from p2gs import _native  # pyright: ignore[reportAttributeAccessIssue]

    native = _native
except ImportError as err:
    if getattr(err, "name", None) == "p2gs._native" or "cannot import name" in str(err):
        why_missing = "p2gs was installed without its native kernels (no C++ compiler was found)"
    else:
        why_missing = f"the native kernels cannot be loaded: {err}"

if native is not None:
    _wanted = os.environ.get("P2GS_ISA")
    if _wanted and _wanted not in native.available_isas():
        raise UserError(f"P2GS_ISA={_wanted} is not among what this machine runs: {', '.join(native.available_isas())}")


_kernel_threads: Optional[int] = None  # inside serial_torch: what torch had


def num_threads() -> int:
    """Threads a kernel may use: those of torch (``torch.set_num_threads``, ``OMP_NUM_THREADS``), inside
    ``serial_torch`` those it had."""
    import torch

    return _kernel_threads or torch.get_num_threads()


@contextmanager
def serial_torch(on: bool = True) -> Iterator[None]:
    """Inside, torch's own operations stay on one thread and the kernels keep all of them; ``on=False``: nothing
    changes.

    What a training step leaves to torch are many operations on some ten thousand numbers. Sharing each out wakes a
    sleeping thread, which takes longer than the work, and the two pools fight for the same cores.
    """
    import torch

    global _kernel_threads
    if not on or native is None or _kernel_threads is not None:
        yield
        return
    before = torch.get_num_threads()
    _kernel_threads = before
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _kernel_threads = None


def keep_memory() -> None:
    """For a process that trains: malloc keeps what a step frees for the next one (up to 1 GiB), which saves the page
    faults.

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
