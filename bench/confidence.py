"""What the measures of a joint (``models/joint_confidence.py``) say of the chance that it is right: data, and the map fitted to them.

    python bench/confidence.py RUN... [--zoo DIR] --out FILE     # a line of JSON per joint, right ones and wrong ones
    python bench/confidence.py --fit FILE                        # the numbers that ship, and how they do on scenes left out

RUN holds a whole fit of a scene of the tuning set. Besides its own joints, sets of motions that the search considered are refined and
measured as the last stage does it. This tool reads ground truth, which no phase may; the numbers that it prints are the one exception.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from ladder import Case, runs_parser
from scipy.optimize import minimize

from p2gs.models import handover
from p2gs.models.discovery import instead_of, relabel
from p2gs.models.discovery.hypotheses import directions, sweep
from p2gs.models.discovery.labels import Graph
from p2gs.models.discovery.problem import build_problem
from p2gs.models.discovery.search import Search
from p2gs.models.evidence import gather_evidence
from p2gs.models.finish import FinishRecord, measure
from p2gs.models.handover import PartMotions
from p2gs.models.joint_confidence import JointEvidence, common_level, features, state_depth
from p2gs.models.refine_motions import refine, single_ways
from p2gs.models.settle import label_gaussians


def searched(case: Case) -> SimpleNamespace:
    """Discovery's problem and search, of the states as discovery sees them."""
    config, options = case.cfg.phases["discovery"].config, {"backend": case.cfg.rasterizer, "device": case.pipeline.device}
    train = [case.scene.select(state=s.state, split="train") for s in case.states]
    seen = [
        gather_evidence(s.gaussians, v, config.evidence_size, config.min_opacity, **options)
        for s, v in zip(case.states, train, strict=True)
    ]
    problem = build_problem(*seen, config.search, case.cfg.seed)[0]
    samples = [s[torch.linspace(0, len(s) - 1, min(256, len(s))).long()] for s in problem.samples]
    search = Search(problem, sweep(problem, directions(problem), samples), config.search.max_parts - 1, config.search.part_cost)
    return SimpleNamespace(problem=problem, graphs=[Graph(s.points, s.normals, s.colours) for s in problem.surfels], search=search)


def considered(case: Case, found: SimpleNamespace, own: PartMotions, sets: int) -> list[tuple[torch.Tensor, list[str]]]:
    """The run's own motions, then sets that the search likes: complete ones, and its own with one exchanged."""
    out = [(own.transforms, own.types)]
    for _, chosen in found.search.solve()[:sets]:
        m = found.search.pool.motions[torch.tensor(chosen)]
        out.append((torch.stack([m.transform(k) for k in range(len(m))]), ["revolute" if bool(t) else "prismatic" for t in m.turn]))
    for k in range(len(own)):
        for T, kind in instead_of(found, own.transforms, own.types, k, count=1):
            changed = own.with_motion(k, kind, T)
            out.append((changed.transforms, changed.types))
    return out


def measured(case: Case, found, states, stacks, level: int, transforms: torch.Tensor, types: list[str]) -> list[dict]:
    """Each joint's measures after the last stage's refinement, and whether it is right."""
    config, views = case.cfg.phases["finish"].config, case.pipeline.views
    options = {"backend": case.cfg.rasterizer, "device": case.pipeline.device}
    explanation = relabel(found, transforms, types)
    labels, margin = label_gaussians(explanation, states)
    motions = PartMotions(types, transforms, torch.zeros(len(types)), labels, margin)
    motions = refine(states, motions, views, config.polish, stacks, seed=case.cfg.seed, **options)
    record = FinishRecord(labels, [m.sign() for m in margin], motions.transforms, motions.transforms)
    record.polish = single_ways(states, motions, views, config.polish, stacks, seed=case.cfg.seed, **options)
    measure(record, states, types, views, stacks, level, **options)
    score = case.score(motions.transforms, types)
    right = {row["pred"] for row in score["joints"] if row["right"]}
    return [{"right": k in right, "type": types[k], **e.as_dict()} for k, e in enumerate(record.evidence)]


def gather(run: Path, zoo: Path, sets: int, out: Path) -> None:
    """A run's lines."""
    case = Case(run, zoo)
    found = searched(case)
    own = handover.load(run / "checkpoints" / "discovery.pt")[0]
    states = [handover.load(run / "checkpoints" / f"sharpen_{s}.pt")[0] for s in (0, 1)]
    level = common_level(case.pipeline.views)
    stacks = [state_depth(s, case.pipeline.views[i], level, backend=case.cfg.rasterizer) for i, s in enumerate(states)]
    for number, (T, types) in enumerate(considered(case, found, own, sets)):
        for row in measured(case, found, states, stacks, level, T, types):
            with out.open("a") as f:
                f.write(json.dumps({"name": case.name, "set": number, **row}) + "\n")


def fitted(x: np.ndarray, right: np.ndarray, weight: np.ndarray, damping: float = 0.01) -> np.ndarray:
    """Weights [F + 1] of features [N, F], no one negative, the constant last: logistic regression with a little damping."""

    def loss(w):
        z = x @ w[:-1] + w[-1]
        return weight @ np.logaddexp(0, np.where(right, -z, z)) / weight.sum() + damping * (w[:-1] ** 2).sum()

    return minimize(loss, np.zeros(x.shape[1] + 1), bounds=[(0, None)] * x.shape[1] + [(None, None)]).x


def fit(file: Path) -> None:
    """Print the weights, and what they reach on scenes left out one by one."""
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    names = list(JointEvidence.__dataclass_fields__)
    x = np.array([features(JointEvidence(**{n: r[n] for n in names})) for r in rows])
    right, scene = np.array([r["right"] for r in rows]), np.array([r["name"] for r in rows])
    weight = 1 / np.array(
        [np.sum((scene == s) & (right == y)) for s, y in zip(scene, right, strict=True)]
    )  # each scene's right, wrong alike
    guess = np.zeros(len(rows))
    for name in sorted(set(scene)):
        w = fitted(x[scene != name], right[scene != name], weight[scene != name])
        guess[scene == name] = 1 / (1 + np.exp(-(x[scene == name] @ w[:-1] + w[-1])))
    old = np.array([r["confidence"] for r in rows])
    print(f"{len(rows)} joints of {len(set(scene))} scenes, {right.sum()} right")
    for name, p in (("left out", guess), ("before", old)):
        brier = float((weight @ (p - right) ** 2) / weight.sum())
        print(f"{name}: Brier {brier:.3f}, right over 0.5 {np.mean(p[right] > 0.5):.2f}, wrong over 0.5 {np.mean(p[~right] > 0.5):.2f}")
    print("weights", [round(float(v), 3) for v in fitted(x, right, weight)])


def main() -> None:
    if "--fit" in sys.argv:
        return fit(Path(sys.argv[sys.argv.index("--fit") + 1]))
    parser = runs_parser(__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=3, help="sets of motions that the search likes, besides the run's own")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    for run in args.runs:
        gather(run, args.zoo, args.sets, args.out)


if __name__ == "__main__":
    main()
