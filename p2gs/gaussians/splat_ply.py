"""Gaussians in the binary PLY layout that public splat viewers open, with one more column: ``int part_id``.

Columns: x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3 part_id, little-endian float32. ``f_rest`` is
channel-major (all higher coefficients of red, then green, then blue); opacity is a logit, scale a logarithm, rot is
wxyz.
"""

from __future__ import annotations

from pathlib import Path
from typing import Optional

import numpy as np
import torch
from torch import Tensor

from p2gs.types import GaussianTensors, UserError

PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
PLY_TYPES |= {
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}


def splat_dtype(sh_bases: int, with_parts: bool) -> np.dtype:
    """The record of one Gaussian with ``sh_bases`` = (degree+1)^2 coefficients a channel."""
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * (sh_bases - 1))),
    ]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return np.dtype([(n, "<f4") for n in names] + ([("part_id", "<i4")] if with_parts else []))


def write_splat_ply(path: Path | str, gaussians: GaussianTensors, part_ids: Optional[Tensor] = None) -> None:
    """Write N Gaussians (as they are: bring them to input coordinates first). part_ids: [N] int or None."""
    sh = gaussians.sh.detach().cpu().float().numpy()
    n, bases = sh.shape[:2]
    rows = np.zeros(n, splat_dtype(bases, part_ids is not None))
    quats = torch.nn.functional.normalize(gaussians.quats.detach().cpu().float(), dim=-1).numpy()
    _fill(rows, ("x", "y", "z"), gaussians.means)
    _fill(rows, [f"f_dc_{i}" for i in range(3)], sh[:, 0])
    _fill(rows, [f"f_rest_{i}" for i in range(3 * (bases - 1))], sh[:, 1:].transpose(0, 2, 1).reshape(n, -1))
    _fill(rows, ["opacity"], gaussians.opacity_logits[:, None])
    _fill(rows, [f"scale_{i}" for i in range(3)], gaussians.log_scales)
    _fill(rows, [f"rot_{i}" for i in range(4)], quats)
    if part_ids is not None:
        rows["part_id"] = part_ids.detach().cpu().numpy()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        file.write(_header(rows.dtype, n))
        file.write(rows.tobytes())


def read_splat_ply(path: Path | str) -> tuple[GaussianTensors, Optional[Tensor]]:
    """Gaussians and part ids ([N] int64, or None where the file has no such column).

    Columns may come in any order and of any numeric type, as other programs write them. Raises UserError when the file
    is no binary little-endian PLY, is cut short or lacks a column.
    """
    rows = _read_vertices(Path(path))
    names = rows.dtype.names or ()
    rest = sum(1 for n in names if n.startswith("f_rest_"))
    need = [n for n in splat_dtype(rest // 3 + 1, False).names or () if n not in ("nx", "ny", "nz")]
    missing = [n for n in need if n not in names]
    if missing or rest // 3 + 1 not in (1, 4, 9, 16) or rest % 3:
        raise UserError(f"{path} is not a Gaussian splat PLY: column '{(missing or ['f_rest_*'])[0]}' is missing")
    wrong = [n for n in need if not np.isfinite(rows[n]).all()]
    if wrong:
        raise UserError(f"{path}: column '{wrong[0]}' holds values that are not finite")

    def take(columns) -> Tensor:
        return torch.from_numpy(np.stack([rows[c].astype(np.float32) for c in columns], axis=1))

    n = len(rows)
    higher = take([f"f_rest_{i}" for i in range(rest)]) if rest else torch.zeros(n, 0)
    sh = torch.cat(
        [take([f"f_dc_{i}" for i in range(3)])[:, None], higher.reshape(n, 3, rest // 3).transpose(1, 2)], dim=1
    )
    gaussians = GaussianTensors(
        take("xyz"),
        take([f"rot_{i}" for i in range(4)]),
        take([f"scale_{i}" for i in range(3)]),
        take(["opacity"])[:, 0],
        sh.contiguous(),
    )
    ids = torch.from_numpy(rows["part_id"].astype(np.int64)) if "part_id" in names else None
    return gaussians, ids


def _fill(rows: np.ndarray, names, values) -> None:
    values = values.detach().cpu().float().numpy() if isinstance(values, Tensor) else values
    for i, name in enumerate(names):
        rows[name] = values[:, i]


def _header(dtype: np.dtype, count: int) -> bytes:
    kinds = {"f4": "float", "i4": "int"}
    lines = ["ply", "format binary_little_endian 1.0", "comment p2gs splats", f"element vertex {count}"]
    lines += [f"property {kinds[dtype[n].str[1:]]} {n}" for n in dtype.names or ()]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def _read_vertices(path: Path) -> np.ndarray:
    data = path.read_bytes()
    end = data.find(b"end_header\n")
    if not data.startswith(b"ply") or end < 0:
        raise UserError(f"{path} is not a PLY file")
    lines = data[:end].decode("ascii", "replace").split("\n")
    if not any(line.startswith("format binary_little_endian") for line in lines):
        raise UserError(f"{path} is not a binary little-endian PLY file")
    count, fields, inside = 0, [], False
    for words in (line.split() for line in lines):
        if words[:1] == ["element"]:
            inside = words[1:2] == ["vertex"]
            if inside and (len(words) != 3 or not words[2].isdecimal() or len(words[2]) > 18):
                raise UserError(f"{path}: the number of Gaussians in its header cannot be read")
            count = int(words[2]) if inside else count
        elif words[:1] == ["property"] and inside:
            if len(words) != 3 or words[1] not in PLY_TYPES:
                raise UserError(f"{path}: property '{' '.join(words[1:])}' cannot be read")
            fields.append((words[-1], "<" + PLY_TYPES[words[1]]))
    if len({name for name, _ in fields}) < len(fields):
        raise UserError(f"{path}: two properties have one name")
    dtype = np.dtype(fields)
    body = data[end + len(b"end_header\n") :]
    if len(body) < count * dtype.itemsize:
        raise UserError(
            f"{path} ends early: {count} Gaussians need {count * dtype.itemsize} bytes, {len(body)} are there"
        )
    return np.frombuffer(body, dtype, count)
