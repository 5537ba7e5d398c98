"""Two gates of part discovery's energy, with ground truth, which no phase may read.

    python bench/gates.py RUN... [--zoo DIR] [--out FILE] [--search]

RUN holds the single states of a scene. (1, with --search) Is the energy at the true motions lower than at those that
are found? (2) How far does refinement that starts at the true motions leave them? Every Gaussian has its best label
under the motions. A line of JSON per run goes to FILE: displacement of each part's points (units of the object scaled
to 1) and turn (degrees) away from the truth; energies.
"""

from __future__ import annotations

from types import SimpleNamespace

import torch
from ladder import Case, runs_parser, to_training, write_rows

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.discovery import discover, relabel
from p2gs.motion.discovery.labels import Graph
from p2gs.motion.discovery.problem import build_problem
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import label_gaussians
from p2gs.ops import se3


def true_motions(case: Case) -> tuple[torch.Tensor, list[str]]:
    """Start -> end of each true joint in training units [K, 4, 4], and their types."""
    out = []
    for joint in case.truth.joints:
        axis = torch.nn.functional.normalize(torch.as_tensor(joint.axis).double(), dim=0)
        T = torch.eye(4, dtype=torch.float64)
        if joint.type == "revolute":
            T = se3.from_screw(
                axis, torch.as_tensor(joint.origin).double(), torch.deg2rad(torch.tensor(float(joint.motion)).double())
            )
        else:
            T[:3, 3] = axis * float(joint.motion)
        out.append(to_training(T, case.similarity))
    return torch.stack(out), [j.type for j in case.truth.joints]


def labelled(case: Case, found, transforms: torch.Tensor, types: list[str]) -> PartMotions:
    """The motions with the best label of every Gaussian of both states."""
    labels, margin = label_gaussians(relabel(found, transforms, types), case.states)
    return PartMotions(list(types), transforms, torch.ones(len(types)), labels, margin)


def left(case: Case, motions: PartMotions, truth: torch.Tensor) -> list[tuple[float, float]]:
    """Mean displacement of each part's points at the start against the true motion's, and the turn between both in
    degrees."""
    out = []
    for k, T in enumerate(truth):
        points = case.states[0].gaussians.means[motions.labels[0] == k + 1].double()
        apart = (se3.apply(T, points) - se3.apply(motions.transforms[k], points)).norm(dim=1).mean()
        turn = torch.rad2deg(se3.screw_parameters(se3.inverse(T) @ motions.transforms[k]).angle)
        out.append((round(float(apart), 4), round(float(turn), 3)))
    return out


def gates(case: Case, search: bool) -> dict:
    """A run's line."""
    config, views = case.cfg.phases["discovery"].config, case.pipeline.views
    options = {"backend": case.cfg.rasterizer, "device": case.pipeline.device}
    seen = case.evidence()
    truth, types = true_motions(case)
    if search:
        found = discover(*seen, case.cfg.num_parts, config.search, case.cfg.seed)
    else:
        problem = build_problem(*seen, config.search, case.cfg.seed)[0]
        found = SimpleNamespace(
            problem=problem, graphs=[Graph(s.points, s.normals, s.colours) for s in problem.surfels]
        )
    judge = Judge(found, case.states, views, config.coarse, found.problem.stacks, seed=case.cfg.seed, **options)
    motions = labelled(case, found, truth, types)
    refined = judge.refine(motions)
    row: dict = {"name": case.name, "left": left(case, refined, truth)}
    if search:
        best = case.discover()[0]
        asked = {"truth": motions, "truth, refined": refined, "found": best}
        for name, m in asked.items():
            value, loss = judge(m)
            row[name] = {"loss": round(loss, 4), "energy": round(value, 4)}
        row |= case.score(best.transforms, best.types)
    return row


def main() -> None:
    parser = runs_parser(__doc__.splitlines()[0])
    parser.add_argument("--search", action="store_true", help="also the energies; needs the time of two discoveries")
    args = parser.parse_args()
    write_rows(args, lambda case: gates(case, args.search))


if __name__ == "__main__":
    main()
