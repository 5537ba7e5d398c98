"""What a machine refuses (a full disk, a folder that cannot be written to, no memory), told in a sentence: no fault of
the program's."""

from __future__ import annotations

import errno

REFUSALS = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.EIO,
    errno.ENAMETOOLONG,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.ESTALE,
)


def is_of_the_machine(err: BaseException) -> bool:
    """Whether the error says that the machine did not do what it was asked to, rather than that the program is
    wrong."""
    return isinstance(err, MemoryError) or (isinstance(err, OSError) and err.errno in REFUSALS)


def machine_says(err: BaseException) -> str:
    """One sentence: which file, and why not."""
    if isinstance(err, MemoryError):
        return "there is not enough memory" + (f" ({' '.join(str(err).split())})" if str(err) else "")
    name, reason = getattr(err, "filename", None), getattr(err, "strerror", None)
    where = "a file of the result could not be written: " if name is None else f"{name}: "
    return where + (reason or str(err))
