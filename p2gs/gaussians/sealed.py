"""Files with a checksum at their end, written whole or not at all: a byte that changed on disk is noticed before it is
trained on.

The last 40 bytes are ``SEAL`` and the SHA-256 of all before them. What reads zip archives (torch.load does) finds its
directory from the end and passes over them.
"""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

SEAL = b"p2gsum1\n"
LENGTH = len(SEAL) + hashlib.sha256().digest_size


class Damaged(Exception):
    """The file is cut short, was changed, or was never sealed; the message says so in a few words."""


def seal(part: Path, path: Path) -> None:
    """Append the checksum to ``part``, flush it to disk, and rename it to ``path``. Raises OSError, for a full disk
    among others."""
    with open(part, "rb+") as file:
        digest = _digest(file, os.fstat(file.fileno()).st_size)
        file.seek(0, os.SEEK_END)
        file.write(SEAL + digest)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def check_seal(path: Path) -> None:
    """Raise Damaged unless the file ends in the checksum of what stands before it."""
    found = path.stat()
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
        raise Damaged("it is no file")  # to open a pipe is to wait for who writes into it
    size = found.st_size
    with open(path, "rb") as file:
        if size < LENGTH:
            raise Damaged("it is cut short")
        file.seek(size - LENGTH)
        stored = file.read()
        if not stored.startswith(SEAL):
            raise Damaged("it is cut short, or has no checksum")
        file.seek(0)
        if _digest(file, size - LENGTH) != stored[len(SEAL) :]:
            raise Damaged("its checksum does not match")


def _digest(file, length: int) -> bytes:
    """SHA-256 of the next ``length`` bytes."""
    sha = hashlib.sha256()
    while length > 0 and (chunk := file.read(min(length, 1 << 20))):
        sha.update(chunk)
        length -= len(chunk)
    return sha.digest()
