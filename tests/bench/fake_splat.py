#!/usr/bin/env python3
"""Stands in for OpenSplat in the test of ``p2gs bench peers``: reads its project, saves Gaussians at the points."""

import json
import sys
import time
from pathlib import Path

import numpy as np

words = sys.argv[1:]
project = Path(words[0])


def option(name):
    return words[words.index(name) + 1]


if "--fail" in words:
    print("no such thing")
    sys.exit(3)
out, steps, every = Path(option("-o")), int(option("-n")), int(option("-s"))
about = json.loads((project / "transforms.json").read_text())
assert about["camera_model"] and all((project / f["file_path"]).is_file() for f in about["frames"])
data = (project / about["ply_file_path"]).read_bytes()
start = data.index(b"end_header\n") + 11
points = np.frombuffer(data[start:], [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in "rgb"])
names = [
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "scale_2",
    *(f"rot_{i}" for i in range(4)),
]
for step in range(every, steps + 1, every):
    rows = np.zeros(len(points), [(n, "<f4") for n in names])
    for n in "xyz":
        rows[n] = points[n]
    rows["opacity"], rows["rot_0"] = 3.0 * step / steps, 1.0
    for n in ("scale_0", "scale_1", "scale_2"):
        rows[n] = -3.5
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property float {n}" for n in names),
    ]
    path = out.with_name(f"{out.stem}_{step}.ply")
    path.write_bytes(("\n".join([*head, "end_header"]) + "\n").encode() + rows.tobytes())
    time.sleep(0.01)
