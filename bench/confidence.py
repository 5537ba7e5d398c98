"""What the measures of a joint (``motion/joint_confidence.py``) say of the chance that it is right: data, and the map
fitted to them.

    python bench/confidence.py RUN... [--zoo DIR] --out FILE     # a line of JSON per joint, right ones and wrong ones
    python bench/confidence.py --fit FILE                        # the numbers that ship, and how they do on scenes left
    out

RUN holds a whole fit of a scene of the tuning set. Besides its own joints, sets of motions that the search considered
are refined and measured as the last stage does it. This tool reads ground truth, which no phase may; the numbers that
it prints are the one exception.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from ladder import Case, runs_parser, to_training
from scipy.optimize import minimize

from p2gs.gaussians import handover
from p2gs.gaussians.handover import PartMotions
from p2gs.models.finish_record import FinishRecord, measure
from p2gs.motion.discovery import instead_of, relabel
from p2gs.motion.discovery.hypotheses import directions, sweep
from p2gs.motion.discovery.labels import Graph
from p2gs.motion.discovery.problem import build_problem
from p2gs.motion.discovery.search import Search
from p2gs.motion.joint_confidence import JointEvidence, common_level, features, nudges, state_depth
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import label_gaussians
from p2gs.ops import se3


def searched(case: Case) -> SimpleNamespace:
    """Discovery's problem and search, of the states as discovery sees them."""
    config, seen = case.cfg.phases["discovery"].config, case.evidence()
    problem = build_problem(*seen, config.search, case.cfg.seed)[0]
    swept = sweep(problem, directions(problem))
    search = Search(problem, swept, config.search.max_parts - 1, config.search.part_cost)
    return SimpleNamespace(
        problem=problem, graphs=[Graph(s.points, s.normals, s.colours) for s in problem.surfels], search=search
    )


def considered(found: SimpleNamespace, own: PartMotions, sets: int) -> list[tuple[torch.Tensor, list[str]]]:
    """Sets of motions that the search likes: complete ones, and the run's own with one exchanged."""
    out = []
    for _, chosen in found.search.solve()[:sets]:
        m = found.search.pool.motions[torch.tensor(chosen)]
        out.append(
            (
                torch.stack([m.transform(k) for k in range(len(m))]),
                ["revolute" if bool(t) else "prismatic" for t in m.turn],
            )
        )
    for k in range(len(own)):
        for T, kind in instead_of(found, own.transforms, own.types, k, count=1):
            changed = own.with_motion(k, kind, T)
            out.append((changed.transforms, changed.types))
    return out


def displaced(case: Case, own: PartMotions, sizes=(0.02, 0.06)) -> list[tuple[torch.Tensor, list[str]]]:
    """The run's own motions with each part off by ``sizes`` (internal units), every part in another of its freedoms:
    wrong joints that nothing has refined."""
    out = []
    points = [case.states[0].gaussians.means[own.labels[0] == k + 1].double() for k in range(len(own))]
    for number, size in enumerate(sizes):
        changed = own.transforms.clone()
        for k, (kind, at) in enumerate(zip(own.types, points, strict=True)):
            if len(at):
                radius = max(float((at - at.mean(0)).square().sum(1).mean().sqrt()), 1e-3)
                pairs = nudges(kind, own.transforms[k], se3.apply(own.transforms[k], at.mean(0)[None])[0], radius, size)
                changed[k] = pairs[(k + number) % len(pairs)][number % 2]
        out.append((changed, own.types))
    return out


def measured(
    case: Case, found, states, stacks, transforms: torch.Tensor, types: list[str], refined: bool
) -> list[dict]:
    """Each joint's measures, after the last stage's refinement if ``refined``, and whether it is right."""
    config, views = case.cfg.phases["finish"].config, case.pipeline.views
    options = {"backend": case.cfg.rasterizer, "device": case.pipeline.device}
    explanation = relabel(found, transforms, types)
    labels, margin = label_gaussians(explanation, states)
    motions = PartMotions(types, transforms, torch.zeros(len(types)), labels, margin)
    judge = Judge(None, states, views, config.polish, stacks, case.cfg.seed, **options)
    if refined:
        motions = judge.refine(motions)
    record = FinishRecord(labels, [m.sign() for m in margin], motions.transforms, motions.transforms)
    record.polish = judge.single_ways(motions)
    measure(record, judge, motions)
    return judged(case, motions.transforms, types, [e.as_dict() for e in record.evidence])


def judged(case: Case, transforms: torch.Tensor, types: list[str], measures: list[dict]) -> list[dict]:
    """The measures of each joint, and whether it is right."""
    right = {row["pred"] for row in case.score(transforms, types)["joints"] if row["right"]}
    return [{"right": k in right, "type": types[k], **m} for k, m in enumerate(measures)]


def own_joints(case: Case, run: Path) -> list[dict]:
    """The joints of the run's twin as its last stage measured them."""
    joints = [p["joint"] for p in json.loads((run / "twin.json").read_text())["parts"][1:]]
    if not joints:
        return []
    transforms = torch.stack(
        [to_training(torch.tensor(j["transform"], dtype=torch.float64), case.similarity) for j in joints]
    )
    measures = json.loads((run / "diagnostics.json").read_text())["joints"]
    for m in measures:
        m["disagreement"] *= case.similarity.scale  # the file's is in the scene's units
    return judged(case, transforms, [j["type"] for j in joints], measures)


def gather(run: Path, zoo: Path, sets: int, out: Path) -> None:
    """A run's lines."""
    case = Case(run, zoo)
    found = searched(case)
    own = handover.load(run / "checkpoints" / "discovery.pt")[0]
    states = [handover.load(run / "checkpoints" / f"sharpen_{s}.pt")[0] for s in (0, 1)]
    level = common_level(case.pipeline.views)
    stacks = [state_depth(s, case.pipeline.views[i], level, backend=case.cfg.rasterizer) for i, s in enumerate(states)]
    rows = own_joints(case, run)
    for refined, proposals in ((True, considered(found, own, sets)), (False, displaced(case, own))):
        for T, types in proposals:
            rows += measured(case, found, states, stacks, T, types, refined)
    with out.open("a") as f:
        f.writelines(json.dumps({"name": case.name, **row}) + "\n" for row in rows)


def fitted(x: np.ndarray, right: np.ndarray, weight: np.ndarray, damping: float = 0.001) -> np.ndarray:
    """Weights [F + 1] of features [N, F], no one negative, the constant last: logistic regression with a little
    damping."""

    def loss(w):
        z = x @ w[:-1] + w[-1]
        return weight @ np.logaddexp(0, np.where(right, -z, z)) / weight.sum() + damping * (w[:-1] ** 2).sum()

    return minimize(loss, np.zeros(x.shape[1] + 1), bounds=[(0, None)] * x.shape[1] + [(None, None)]).x


def fit(file: Path) -> None:
    """Print the weights, and what they reach on scenes left out one by one."""
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    rows = [r for r in rows if r["views"]]  # what no photograph shows has no confidence whatever the weights
    names = list(JointEvidence.__dataclass_fields__)
    x = np.array([features(JointEvidence(**{n: r[n] for n in names})) for r in rows])
    right, scene = np.array([r["right"] for r in rows]), np.array([r["name"] for r in rows])
    # each scene's right, wrong alike
    weight = 1 / np.array([np.sum((scene == s) & (right == y)) for s, y in zip(scene, right, strict=True)])
    guess = np.zeros(len(rows))
    for name in sorted(set(scene)):
        w = fitted(x[scene != name], right[scene != name], weight[scene != name])
        guess[scene == name] = 1 / (1 + np.exp(-(x[scene == name] @ w[:-1] + w[-1])))
    old = np.array([r["confidence"] for r in rows])
    print(f"{len(rows)} joints of {len(set(scene))} scenes, {right.sum()} right")
    for name, p in (("left out", guess), ("before", old)):
        brier = float((weight @ (p - right) ** 2) / weight.sum())
        print(
            f"{name}: Brier {brier:.3f}, right over 0.5 {np.mean(p[right] > 0.5):.2f}, wrong over 0.5 "
            f"{np.mean(p[~right] > 0.5):.2f}"
        )
    print("weights", [round(float(v), 3) for v in fitted(x, right, weight)])


def main() -> None:
    if "--fit" in sys.argv:
        return fit(Path(sys.argv[sys.argv.index("--fit") + 1]))
    parser = runs_parser(__doc__.splitlines()[0])
    parser.add_argument(
        "--sets", type=int, default=3, help="sets of motions that the search likes, besides the run's own joints"
    )
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    for run in args.runs:
        gather(run, args.zoo, args.sets, args.out)


if __name__ == "__main__":
    main()
