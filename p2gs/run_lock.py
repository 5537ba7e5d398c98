"""One fit at a time in a result folder: a lock that the kernel gives back when its processes are gone, however they
ended."""

from __future__ import annotations

import errno
import os
import socket
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Iterator

from p2gs.types import UserError

PATIENCE = 60.0  # seconds that a killed run's other process may take to save its state and end; as in side_stage
GRACE = 2.0  # seconds that a process takes to go that has just been killed
_held: list[int] = []


def held() -> tuple[int, ...]:
    """File descriptors of the locks that this process holds; a process that gets them keeps others out for as long as
    it runs."""
    return tuple(_held)


@contextmanager
def locked(run_dir: Path) -> Iterator[None]:
    """Hold RUN/checkpoints/.lock. Raises UserError where another fit runs in that folder.

    Of a run that was killed a process may be left that saves its state: that one is waited for. File systems without
    locks (some network shares) go unguarded, with a note.
    """
    import fcntl

    path = Path(run_dir) / "checkpoints" / ".lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+") as file:
        began, told = time.monotonic(), False
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                pid, host = _owner(file)
                waited, gone = time.monotonic() - began, _gone(pid, host)
                if waited > (PATIENCE if gone else GRACE):
                    raise UserError(
                        f"{run_dir}: another fit is running in this folder (process {pid} on {host}); wait until it "
                        "has ended, "
                        "or name another folder with --run"
                    ) from None
                if gone and not told:
                    print(
                        f"{run_dir}: waiting for what is left of process {pid} to save its state",
                        file=sys.stderr,
                        flush=True,
                    )
                told = told or gone
                time.sleep(0.2)
            except OSError as err:
                if err.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL):
                    raise
                print(
                    f"note: {path}: this file system has no locks ({err.strerror}); start no second fit in the folder",
                    file=sys.stderr,
                )
                break
        file.truncate(0)
        file.write(f"{os.getpid()} {socket.gethostname()}\n")
        file.flush()
        _held.append(file.fileno())
        try:
            yield
        finally:
            _held.remove(file.fileno())


def _owner(file) -> tuple[str, str]:
    """(process number, host) as the one who holds the lock has written them."""
    file.seek(0)
    words = file.read().split()
    return (words[0], words[1]) if len(words) == 2 else ("unknown", "an unknown host")


def _gone(pid: str, host: str) -> bool:
    """Whether that process of this machine has ended, so that only what it started can hold its lock."""
    if host != socket.gethostname() or not pid.isdecimal():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except OSError:  # another user's
        return False
    return _is_zombie(pid)


def _is_zombie(pid: str) -> bool:
    """Killed, but not yet waited for by who started it (Linux tells; elsewhere it counts as running)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (OSError, IndexError):
        return False
