"""``--meta FILE``: what only a person can know of an object, its author, licence, category and identifiers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Union

import yaml

from p2gs.types import UserError

Scalar = Union[str, int, float]
KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")  # what a USD dictionary takes for a key
QCODE = re.compile(r"Q[0-9]+")  # Wikidata's identifiers, as SimReady's rule SL.QCODE.001 has them


def read_meta(path: Path | str) -> dict[str, Scalar]:
    """The fields of a YAML or JSON file, for instance ``author``, ``asset_license``, ``category``, ``qcode``,
    ``asset_name``.

    Raises UserError for a file that is not there or no mapping of names to texts and numbers, and for a malformed
    ``qcode``.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"--meta: there is no file {path}")
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as err:
        raise UserError(f"--meta: {path} is neither YAML nor JSON: {' '.join(str(err).split())}") from err
    if not isinstance(data, dict):
        raise UserError(f"--meta: {path} holds no fields, expected lines such as 'author: Jane Doe'")
    out: dict[str, Scalar] = {}
    for key, value in data.items():
        if not isinstance(key, str) or not KEY.fullmatch(key):
            raise UserError(
                f"--meta: {path}: field '{key}': a name is letters, digits and underscores, and no digit comes first"
            )
        if isinstance(value, bool) or not isinstance(value, (str, int, float)):
            value = None if value is None else str(value)  # a date, as YAML reads it
        if value is None or value == "":
            raise UserError(f"--meta: {path}: field '{key}' is empty")
        out[key] = value
    if "qcode" in out and not QCODE.fullmatch(str(out["qcode"])):
        raise UserError(
            f"--meta: {path}: qcode is '{out['qcode']}', expected Wikidata's identifier of the kind of object, such "
            "as Q42177"
        )
    return out
