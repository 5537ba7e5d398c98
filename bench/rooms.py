"""Is what ``p2gs data capture`` accepts right? Rooms of ``capture_room.py``, each held against its true cameras.

    python bench/rooms.py OUT [--kinds plain textured board] [--seeds 0 1 2] [--photos 24]

Goes on where it stopped: a line of JSON per room in OUT/rooms.jsonl. Right is: the states at most 3 mm apart on the
base, and with the board the scale within 0.3 %. Wrong is: accepted, and not right. The true masks are given, for this
is about cameras.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections import Counter
from pathlib import Path

import numpy as np
from capture_room import KINDS, write_room

from p2gs.data.capture.pipeline import Options, capture_scene
from p2gs.scores.capture import base_points, camera_pairs, rigid_between
from p2gs.types import UserError

APART, SCALE = 3.0, 0.003  # mm; share


def scored(scene: Path, truth: Path) -> dict:
    """How far a scene's states are apart on the true base (mm), its start cameras off (mm, root mean square) and its
    scale (share), after the start's similarity."""
    pairs = camera_pairs(scene, truth)
    own, true = pairs["start"]
    T = rigid_between(own, true, with_scale=True)
    placed = [pairs[s][0].copy() for s in ("start", "end")]
    for p in placed:
        p[:, :3, 3] = p[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    D = rigid_between(placed[1], pairs["end"][1], with_scale=False)
    points = base_points(truth)
    assert points is not None  # write_room has made it
    apart = np.linalg.norm(points @ D[:3, :3].T + D[:3, 3] - points, axis=1).mean()
    off = np.linalg.norm(placed[0][:, :3, 3] - true[:, :3, 3], axis=1)
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    return {
        "apart_mm": round(1000 * float(apart), 3),
        "start_off_mm": round(1000 * float(np.sqrt((off**2).mean())), 3),
        "metres_per_unit": round(scale, 5),
        "placed": [len(pairs[s][0]) for s in ("start", "end")],
    }


def verdict(row: dict) -> str:
    """refused, right or wrong."""
    if "refused" in row:
        return "refused"
    metric = row["scale"] != "board" or abs(row["metres_per_unit"] - 1) <= SCALE
    return "right" if row["apart_mm"] <= APART and metric else "WRONG"


def run(out: Path, kind: str, seed: int, photos: int) -> dict:
    """The row of one room; its pictures are kept while it is not right."""
    room, began = out / f"{kind}_{seed}", time.monotonic()
    if not (room / "gt" / "trans.json").exists():
        write_room(room, kind, seed, photos)
    row: dict = {"kind": kind, "seed": seed, "photos": photos}
    try:
        scene = capture_scene(room / "start", room / "end", room / "scene", Options(masks=room / "masks"))
        facts = json.loads((scene / "capture.json").read_text())
        row |= scored(scene, room / "gt") | {"scale": facts["scale"]["source"], "bias": facts["bias"]}
    except UserError as err:
        row["refused"] = str(err)
    row |= {"verdict": verdict(row), "seconds": round(time.monotonic() - began, 1)}
    if row["verdict"] != "WRONG":
        shutil.rmtree(room)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--photos", type=int, default=24)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "rooms.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(r["kind"], r["seed"]) for r in rows}
    for seed in args.seeds:
        for kind in args.kinds:
            if (kind, seed) in done:
                continue
            rows.append(run(args.out, kind, seed, args.photos))
            with open(path, "a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
            print(json.dumps(rows[-1]), flush=True)
    for kind in args.kinds:
        mine = [r for r in rows if r["kind"] == kind]
        count = Counter(r["verdict"] for r in mine)
        apart = [r["apart_mm"] for r in mine if r["verdict"] == "right"]
        worst = f", at most {max(apart):.2f} mm apart" if apart else ""
        print(f"{kind}: {len(mine)} rooms, right {count['right']}{worst}, refused {count['refused']}, "
              f"WRONG {count['WRONG']}")  # fmt: skip


if __name__ == "__main__":
    main()
