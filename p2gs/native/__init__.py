"""The native kernels, or the reason why they are missing.

``native`` is the extension module ``p2gs._native`` or None; ``why_missing`` then says why in one sentence.
"""

from __future__ import annotations

import os
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Callable, Iterator, Optional, Sequence, TypeVar

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


S = TypeVar("S")
T = TypeVar("T")
_kernel_threads: Optional[int] = None  # inside serial_torch: what torch had


class _Thread(threading.local):
    """alone: is this a thread of ``at_once``?"""

    alone = False


_this = _Thread()


def num_threads() -> int:
    """Threads a kernel may use: those of torch (``torch.set_num_threads``, ``OMP_NUM_THREADS``), inside
    ``serial_torch`` those it had, inside ``at_once`` one."""
    import torch

    return 1 if _this.alone else _kernel_threads or torch.get_num_threads()


def at_once(job: Callable[[S], T], items: Sequence[S]) -> list[T]:
    """What ``job`` returns for each of ``items``, in their order, each on a thread of its own with kernels and torch on
    that one thread.

    For jobs that do not wait for one another and change nothing that another one looks at: two of them on two cores
    take little longer than one, while one that shares its small operations out gains next to nothing. With one thread,
    and inside such a job, they run one after the other: results are the same. Raises what the first of them raises.
    """
    import torch

    threads = min(num_threads(), len(items))
    if threads < 2:
        return [job(item) for item in items]
    before, grad = torch.get_num_threads(), torch.is_grad_enabled()

    def run(item: S) -> T:
        _this.alone = True
        torch.set_num_threads(1)
        with torch.set_grad_enabled(grad):
            return job(item)

    try:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(run, items))
    finally:
        torch.set_num_threads(before)


@contextmanager
def serial_torch(on: bool = True) -> Iterator[None]:
    """Inside, torch's own operations stay on one thread and the kernels keep all of them; ``on=False``: nothing
    changes.

    What a training step leaves to torch are many operations on some ten thousand numbers. Sharing each out wakes a
    sleeping thread, which takes longer than the work, and the two pools fight for the same cores.
    """
    import torch

    global _kernel_threads
    if not on or native is None or _kernel_threads is not None or _this.alone:
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
