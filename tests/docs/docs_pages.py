"""Docs as data: a page's fenced blocks and the commands in it."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
PAGES = sorted((REPOSITORY / "docs").rglob("*.md"))
FENCE = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.S | re.M)


@dataclass
class Block:
    kind: str
    title: str
    text: str


def blocks(page: Path) -> list[Block]:
    return [Block(*m) for m in FENCE.findall(page.read_text())]


def command_lines(text: str) -> list[list[str]]:
    """The words of each line that runs p2gs (``lightning fit`` is one too); comments and line continuations are
    undone."""
    lines = text.replace("\\\n", " ").splitlines()
    return [
        words[1:] for line in lines if (words := shlex.split(line, comments=True)) and words[0] in ("p2gs", "lightning")
    ]


def page_commands(page: Path) -> list[list[str]]:
    """Commands of the bash blocks, of code between backticks, and (README) of indented blocks."""
    text = page.read_text()
    found = [words for b in blocks(page) if b.kind == "bash" for words in command_lines(b.text)]
    outside = FENCE.sub("", text)
    indented = "\n".join(line[4:] for line in outside.splitlines() if line.startswith("    "))
    return found + command_lines(indented)


def write_files(page: Path, folder: Path) -> list[str]:
    """Save the page's titled blocks; returns the plugin modules among them (Python files that register something)."""
    for b in blocks(page):
        if b.title:
            (folder / b.title).write_text(b.text)
    return [
        b.title.removesuffix(".py") for b in blocks(page) if b.kind == "python" and b.title and "register" in b.text
    ]
