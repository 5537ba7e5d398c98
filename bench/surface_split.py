"""Where the Chamfer distance of a run's parts comes from. A bench tool that reads ground truth, which no phase may.

    python bench/surface_split.py RUN... [--root SCENES] [--out FILE]

Every part's distance (x1000, mean of the states, as ``p2gs test`` has it) is split into terms that sum to it:

    seen      true points that three training photographs of a state see, as far as the nearest reconstructed point is
    within NEAR of them,
              and reconstructed points within NEAR of such a true point
    lost      other true points that were seen
    hidden    true points that were not seen
    false     other reconstructed points, in space that three photographs look through
    closing   other reconstructed points: surface in space that nobody saw

``seen``'s floor is what the true surface's samples score against one another. Beside it the bound: the true seen
surface alone. A line of JSON per run goes to FILE.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from p2gs.data.ground_truth import GroundTruth
from p2gs.metrics.chamfer import POINTS, read_part_meshes, sample_surface, triangles
from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh, largest_components
from p2gs.scores.evaluate import open_scene
from p2gs.types import Camera

# of the object's size (half the longest side of a unit-sphere object is .5 to 1): three voxels of a mesh, five pixels
NEAR = 0.02
ENOUGH = 3  # photographs
TERMS = ("seen", "lost", "hidden", "false", "closing")


class Caster:
    """First hits of rays on triangles [F, 3, 3]."""

    def __init__(self, corners: np.ndarray):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.scene = EmbreeScene()
        TriangleMesh(self.scene, corners.astype(np.float32))

    def hit(self, origin: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance [R] in lengths of ``ways`` [R, 3] (inf: none) and triangle [R] (-1: none)."""
        ways = np.ascontiguousarray(ways, np.float32)
        origins = np.broadcast_to(np.asarray(origin, np.float32), ways.shape)
        out = self.scene.run(np.ascontiguousarray(origins), ways, output=True)
        none = out["primID"] < 0
        return np.where(none, np.inf, out["tfar"]), np.where(none, -1, out["primID"])


class Truth:
    """The true parts of a scene in both states, and what its training photographs see of them."""

    def __init__(self, scene, truth: GroundTruth):
        self.views = [(v.state, v.camera) for v in scene.views if v.split == "train"]
        self.motions = [torch.eye(4, dtype=torch.float64)] + [j.transform.double() for j in truth.joints]
        self.parts = []
        for state in (0, 1):
            paths = truth.meshes(state)
            read = read_part_meshes(paths.whole, paths.static, paths.dynamic)
            self.parts.append([Mesh.of(m) for m in (read.static, *read.movable)])
        corners = [[triangles(m) for m in parts] for parts in self.parts]
        self.part_of = [np.repeat(np.arange(len(c)), [len(x) for x in c]) for c in corners]
        self.casters = [Caster(np.concatenate(c)) for c in corners]
        points = np.concatenate([m.vertices for m in self.parts[0]])
        self.size = float((points.max(0) - points.min(0)).max())

    def at(self, points: np.ndarray, part: int, state: int, to: int) -> np.ndarray:
        """Points [N, 3] of a part in one state, where they are in the other."""
        T = self.motions[part].numpy() if to > state else np.linalg.inv(self.motions[part].numpy())
        return points if to == state else points @ T[:3, :3].T + T[:3, 3]

    def looks(self, points: np.ndarray, state: int, margin: float) -> tuple[np.ndarray, np.ndarray]:
        """How many photographs of a state see points [N, 3] (nothing stands more than ``margin`` before them), and how
        many look through them (nothing stands before or up to ``margin`` behind them), [N] each."""
        seen, through = np.zeros((2, len(points)), int)
        for s, camera in self.views:
            if s != state:
                continue
            eye = camera.position.double().numpy()
            inside = within(points, camera)
            way = points - eye
            far = np.linalg.norm(way, axis=1)
            hit = self.casters[state].hit(eye, way)[0] * far
            seen += inside & (hit > far - margin)
            through += inside & (hit > far + margin)
        return seen, through


def within(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Which points [N, 3] fall into a camera's image, [N] bool."""
    p = points @ camera.viewmat[:3, :3].double().numpy().T + camera.viewmat[:3, 3].double().numpy()
    uv = p @ camera.K.double().numpy().T
    uv = uv[:, :2] / np.maximum(p[:, 2:], 1e-9)
    return (p[:, 2] > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)


def split_part(truth: Truth, part: int, made: list[Mesh], margin: float) -> tuple[dict[str, float], float, float]:
    """Terms of one part's Chamfer distance (x1000, mean of the states), the floor of ``seen``, and the score of the
    true seen surface.

    made: its meshes by state.
    """
    near, terms = NEAR * truth.size, dict.fromkeys(TERMS, 0.0)
    floor = bound = 0.0
    for state in (0, 1):
        true, again = (sample_surface(truth.parts[state][part], POINTS, (0, k)) for k in (1, 2))
        by_state = [truth.looks(truth.at(true, part, state, s), s, margin)[0] >= ENOUGH for s in (0, 1)]
        seen = by_state[0] | by_state[1]
        within_truth = search_tree(true).query(again)[0] ** 2
        floor += 1000 * 2 * within_truth.mean() / 2
        if seen.any():
            bound += 500 * float((search_tree(true[seen]).query(again)[0] ** 2).mean() + within_truth.mean())
        mesh = largest_components(Mesh.of(made[state]), 0.1, weld=True) if len(made[state].faces) else None
        if mesh is None:
            return {}, floor, bound
        points = sample_surface(mesh, POINTS, (0, 0))
        to_made = search_tree(points).query(true)[0]
        from_made, _ = search_tree(true).query(points)
        beside = search_tree(true[seen]).query(points)[0] < near if seen.any() else np.zeros(len(points), bool)
        through = [truth.looks(truth.at(points, part, state, s), s, margin)[1] >= ENOUGH for s in (0, 1)]
        through = through[0] | through[1]
        rows = {
            "lost": seen & (to_made >= near),
            "hidden": ~seen,
            "false": ~beside & through,
            "closing": ~beside & ~through,
        }
        for name, which in rows.items():
            d = to_made if name in ("lost", "hidden") else from_made
            terms[name] += 500 * float((d[which] ** 2).sum()) / POINTS
        terms["seen"] += (
            500 * float((to_made[seen & (to_made < near)] ** 2).sum() + (from_made[beside] ** 2).sum()) / POINTS
        )
    return terms, floor, bound


def split(truth: Truth, made: list[list[Mesh]]) -> dict:
    """Terms by part. made: meshes by state and true part (base first)."""
    margin, out = 2e-3 * truth.size, []
    for part in range(len(truth.parts[0])):
        terms, floor, bound = split_part(truth, part, [m[part] for m in made], margin)
        out.append({"terms": terms, "sum": sum(terms.values()), "floor": floor, "seen_alone": bound})
    return {"static": out[0], "movable": out[1:]}


def of_run(run: Path, truth: Truth) -> list[list[Mesh]]:
    """The run's meshes in the order of the true parts, an empty one where a part was not found."""
    from p2gs.surface.mesh import read_meshes

    assignment = {
        j["gt"]: j["pred"]
        for j in json.loads((run / "metrics.json").read_text())["joints"]["joints"]
        if j["errors"] is not None
    }
    out = []
    for name in ("start", "end"):
        made = read_meshes(run, name)
        found = [made[1 + assignment[i]] if i in assignment else Mesh.empty() for i in range(len(truth.motions) - 1)]
        out.append([made[0], *found])
    return out


def line(name: str, row: dict) -> str:
    terms = "  ".join(f"{k} {row['terms'].get(k, float('nan')):6.2f}" for k in TERMS)
    return f"{name:24s} sum {row['sum']:6.2f}  {terms}  floor {row['floor']:.2f}  seen alone {row['seen_alone']:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    for run in options.runs:
        truth = Truth(*open_scene(run))
        row = split(truth, of_run(run, truth))
        print(line(f"{run.name} static", row["static"]), flush=True)
        for i, part in enumerate(row["movable"]):
            print(line(f"  movable {i}", part), flush=True)
        if options.out:
            with options.out.open("a") as file:
                file.write(json.dumps({"run": run.name} | row) + "\n")


if __name__ == "__main__":
    main()
