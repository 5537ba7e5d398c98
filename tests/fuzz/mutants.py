"""Damage to files: to their bytes, to the values inside JSON and YAML, to what a PNG or PLY header claims, to the file
itself.

Every function takes a ``random.Random`` and is a pure function of it and its input.
"""

from __future__ import annotations

import json
import os
import random
import re
import struct
import zlib
from pathlib import Path
from typing import Any, Callable

ODD_NUMBERS = (
    0,
    -1,
    1,
    0.5,
    1e-320,
    1e38,
    -1e39,
    1e308,
    2**31,
    2**63,
    10**30,
    10**400,
    float("nan"),
    float("inf"),
    -float("inf"),
)
ODD_TEXTS = (
    "",
    " ",
    ".",
    "..",
    "/",
    "x",
    "null",
    "nan",
    "1e999",
    "../../../../etc/hostname",
    "/etc/hostname",
    "~/x",
    "a" * 300,
    "a/" * 3000,
    "b" * 50_000,
    "\0",
    "a\0b",
    "\ud800",
    "\u202e",
    "<script>alert(1)</script>",
    "%s%n",
    "{}",
    "C:\\x",
    "-1",
    "--help",
    "é" * 200,
)
ODD_YAML = (
    "!!python/object/apply:os.system ['true']",
    "!!python/name:os.system",
    "2001-99-99",
    "0o9",
    "190:99:99",
    "!!map x",
    "!!set {a, b}",
    "&a [*a]",
    "? [a]\n: b",
    "<<: 5",
    "*nothing",
    "%TAG ! x",
    "!!binary '%'",
    "!!int x",
    "!!float .",
    "[" * 2000,
    "{a: " * 300,
    "a: b: c",
    "- - - -\n  :",
    "\t",
    "a: &a [x, x, x, x, x, x, x, x]\nb: &b [*a, *a, *a, *a, *a, *a, *a, *a]\nc: &c [*b, *b, *b, *b, *b, *b, *b, *b]\n"
    "d: &d [*c, *c, *c, *c, *c, *c, *c, *c]\ne: &e [*d, *d, *d, *d, *d, *d, *d, *d]\nf: &f [*e, *e, *e, *e, *e, *e, "
    "*e, *e]\n"
    "g: &g [*f, *f, *f, *f, *f, *f, *f, *f]\nh: &h [*g, *g, *g, *g, *g, *g, *g, *g]\nphases: *h\nframe_0_0: "
    "{cam_in_ob: *h}",
)

ODD_WORDS = (
    b"",
    b"-1",
    b"0",
    b"7",
    b"999999999999",
    b"9" * 30,
    b"1e9",
    b"nan",
    b"vertex",
    b"list",
    b"double",
    b"uchar",
    b"\xff",
    b"property float x",
)


def odd_value(rng: random.Random) -> Any:
    """Something that hardly any field expects."""
    kind = rng.randrange(8)
    if kind < 3:
        return rng.choice(ODD_NUMBERS)
    if kind < 5:
        return rng.choice(ODD_TEXTS)
    if kind < 6:
        return rng.choice((None, True, False, [], {}, [[]], [{}], {"": None}))
    if kind < 7:
        return [rng.choice(ODD_NUMBERS) for _ in range(rng.choice((1, 2, 3, 4, 9, 16, 17, 5000)))]
    deep: Any = 0
    for _ in range(rng.choice((3, 40, 200))):
        deep = [deep] if rng.random() < 0.5 else {"a": deep}
    return deep


def _places(tree: Any, found: list, parent=None, key=None, limit: int = 5000) -> list:
    """(container, key) of every value in a tree."""
    if parent is not None:
        found.append((parent, key))
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for k, value in list(items):
        if len(found) < limit:
            _places(value, found, tree, k)
    return found


def mutate_tree(tree: Any, rng: random.Random) -> Any:
    """One to three changes: a value replaced, removed, renamed, doubled, wrapped, made text, or two exchanged. The tree
    is changed."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        places = _places(tree, [])
        if not places or rng.random() < 0.03:
            return odd_value(rng)
        parent, key = rng.choice(places)
        how = rng.randrange(8)
        if how < 3:
            parent[key] = odd_value(rng)
        elif how == 3:
            del parent[key]
        elif how == 4:
            parent[key] = rng.choice(([parent[key]], {"x": parent[key]}, str(parent[key])))
        elif how == 5 and isinstance(parent, dict):
            parent[rng.choice(ODD_TEXTS)] = parent.pop(key)
        elif how == 6 and isinstance(parent, list):
            parent.insert(key, json.loads(json.dumps(parent[key])))
        else:
            other, index = rng.choice(places)
            try:
                parent[key], other[index] = other[index], parent[key]
            except (IndexError, KeyError):  # removed by an earlier change
                parent[key] = odd_value(rng)
    return tree


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bits flipped, a stretch cut, doubled, zeroed or made noise, or the end cut off. Never the same bytes (but for
    empty ones)."""
    out = bytearray(data)
    if not out:
        return b"\0"
    for _ in range(rng.choice((1, 1, 1, 4, 30))):
        at = rng.randrange(len(out)) if rng.random() < 0.6 else rng.randrange(min(len(out), 400))
        span = min(rng.choice((1, 4, 16, 300)), len(out) - at)
        how = rng.randrange(6)
        if how < 2:
            out[at] ^= 1 << rng.randrange(8)
        elif how == 2:
            del out[at : at + span]
        elif how == 3:
            out[at:at] = out[at : at + span]
        elif how == 4:
            out[at : at + span] = rng.choice((bytes(span), rng.randbytes(span), b"\xff" * span))
        else:
            del out[at:]
        if not out:
            return b""
    return bytes(out) if bytes(out) != data else bytes(out) + b"\n"


def mutate_json(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.15:
        return mutate_bytes(data, rng)
    if rng.random() < 0.03:
        return rng.choice(
            (b"[" * 200_000, b'{"frames": ' * 20_000, b"9" * 100_000, b"\xff\xfe", b"NaN", b"null", b"{}")
        )
    return json.dumps(mutate_tree(json.loads(data), rng)).encode()


def mutate_yaml(data: bytes, rng: random.Random) -> bytes:
    import yaml

    if rng.random() < 0.2:
        return mutate_bytes(data, rng)
    if rng.random() < 0.3:
        lines = data.decode().splitlines()
        lines[rng.randrange(len(lines)) :: len(lines) + 1] = [rng.choice(ODD_YAML)]
        return "\n".join(lines).encode()
    if rng.random() < 0.1:
        return rng.choice(ODD_YAML).encode()
    tree = mutate_tree(yaml.safe_load(data), rng)
    try:
        return yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass")
    except (yaml.YAMLError, ValueError, RecursionError):  # numbers and depths that YAML cannot write
        return mutate_bytes(data, rng)


def mutate_png(data: bytes, rng: random.Random) -> bytes:
    """Bytes, or another size, depth or colour type in the header, with a sum that fits it."""
    if rng.random() < 0.5 or data[12:16] != b"IHDR":
        return mutate_bytes(data, rng)
    width, height, *rest = struct.unpack(">IIBBBBB", data[16:29])
    sizes = (0, 1, width, height, 3 * width, 1 << 13, 1_000_000, 1 << 30, (1 << 31) - 1, (1 << 32) - 1)
    if rng.random() < 0.7:
        width, height = rng.choice(sizes), rng.choice(sizes)
    else:
        rest[rng.randrange(5)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, *rest)
    return data[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]


def mutate_header(data: bytes, rng: random.Random) -> bytes:
    """A PLY or another file whose text header comes first: a word of it replaced."""
    if rng.random() < 0.4:
        return mutate_bytes(data, rng)
    head, mark, body = data.partition(b"end_header\n")
    words = re.split(rb"(\s+)", head)
    words[2 * rng.randrange(len(words) // 2 + 1)] = rng.choice(ODD_WORDS)
    return b"".join(words) + mark + body


def mutate_numbers(data: bytes, rng: random.Random) -> bytes:
    """Eight aligned bytes (a count, a coordinate) replaced by an odd number, as in COLMAP's binary files."""
    if rng.random() < 0.4 or len(data) < 9:
        return mutate_bytes(data, rng)
    at = rng.choice((0, rng.randrange(len(data) - 8)))
    whole, real = rng.choice((-1, 0, 2**31, 2**40, 2**62)), rng.choice((float("nan"), 1e308, -1.0))
    odd = rng.choice((struct.pack("<q", whole), struct.pack("<d", real)))
    return data[:at] + odd + data[at + 8 :]


def mutate_text(data: bytes, rng: random.Random) -> bytes:
    """A word of a text file replaced."""
    if rng.random() < 0.4:
        return mutate_bytes(data, rng)
    words = re.split(rb"(\s+)", data)
    odd = rng.choice((str(rng.choice(ODD_NUMBERS[:-5])), "nan", "inf", rng.choice(ODD_TEXTS)))
    words[2 * rng.randrange(len(words) // 2 + 1)] = odd.encode("utf-8", "surrogatepass")
    return b"".join(words)


BY_SUFFIX: dict[str, Callable[[bytes, random.Random], bytes]] = {
    ".json": mutate_json,
    ".yaml": mutate_yaml,
    ".yml": mutate_yaml,
    ".png": mutate_png,
    ".ply": mutate_header,
    ".bin": mutate_numbers,
    ".txt": mutate_text,
}


def mutate_file(path: Path, rng: random.Random) -> str:
    """Damage one file in place; returns what was done. Now and then the file itself goes, or becomes something else."""
    how = rng.random()
    if how < 0.9:
        path.write_bytes(BY_SUFFIX.get(path.suffix, mutate_bytes)(path.read_bytes(), rng))
        return "content"
    path.unlink()
    if how < 0.93:
        return "gone"
    if how < 0.95:
        path.mkdir()
        return "a folder"
    if how < 0.97:
        os.symlink(path.name, path)
        return "a link to itself"
    if how < 0.99:
        os.symlink("/etc/hostname", path)
        return "a link out of the root"
    os.mkfifo(path)
    return "a pipe"
