"""Two reconstructed states -> parts, motions, labels: the stages in order."""

from __future__ import annotations

import time
from typing import Callable, Optional

import torch
from torch import Tensor

from p2gs.motion.discovery.config import DiscoveryConfig
from p2gs.motion.discovery.describe import describe, nearest_evidence
from p2gs.motion.discovery.explanations import again, divided, extended, finish, ranked
from p2gs.motion.discovery.finish import Explanation
from p2gs.motion.discovery.hypotheses import directions, static_axes, sweep
from p2gs.motion.discovery.labels import Graph, Labelling
from p2gs.motion.discovery.problem import FEWEST, Problem, build_problem, resampled
from p2gs.motion.discovery.result import Discovery
from p2gs.motion.discovery.rigid import Motions
from p2gs.motion.discovery.search import Search
from p2gs.native import at_once
from p2gs.types import UserError
from p2gs.visibility.depth_stack import StateEvidence


def discover(
    start: StateEvidence,
    end: StateEvidence,
    num_parts: "int | str" = "auto",
    config: Optional[DiscoveryConfig] = None,
    seed: int = 0,
    progress: Optional[Callable[[str, float], None]] = None,
) -> Discovery:
    """Find the moving parts, their motions and who belongs to them. No ground truth, no learning.

    num_parts: upper bound that counts the static base, or "auto" (``max_parts``).  progress: called with a stage's name
    and the share done. Raises UserError for a bad ``num_parts``.  Deterministic for a seed.
    """
    config = config or DiscoveryConfig()
    if num_parts != "auto" and (not isinstance(num_parts, int) or num_parts < 1):
        raise UserError(
            f"num_parts is {num_parts!r}, expected 'auto' or a whole number of parts that counts the static base"
        )
    limit = (config.max_parts if num_parts == "auto" else num_parts) - 1
    tell = progress or (lambda stage, share: None)
    clock, seconds = time.perf_counter(), {}

    def lap(stage: str, share: float) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[stage], clock = round(now - clock, 2), now
        tell(stage, share)

    problem, figures = build_problem(start, end, config, seed)
    lap("evidence", 0.2)
    graphs = [Graph(s.points, s.normals, s.colours) for s in problem.surfels]
    explanations: list[Explanation] = []
    search = None
    enough = max(int(m.sum()) for m in problem.moved) >= config.min_moved
    if limit > 0 and enough and min(map(len, problem.samples)) >= FEWEST:
        axes, still = directions(problem), static_axes(problem)
        most = max(limit, config.max_parts - 1)  # a bound cuts what is found, not the search
        sets: list[Motions] = []
        figures |= {"axes": axes.tolist(), "search": []}
        looks = [problem, *(resampled(problem, seed + number) for number in range(1, config.searches))]
        done = at_once(lambda looked: searched(looked, axes, most), looks)
        search = done[0][0]
        for one, found in done:
            sets += [f for f in found[: config.candidates] if not any(search.agree(f, other) for other in sets)]
            tried = {"motions_tried": len(one.swept.motions)}
            figures["search"].append({**tried, **one.trace[-1]} if one.trace else {})
        lap("selection", 0.7)
        explanations = at_once(lambda motions: finish(problem, graphs, motions, limit, still), sets)
        explanations += again(problem, graphs, search, explanations, limit, still)
        explanations = ranked(search, explanations)
        # one after another, as additions join the pool
        best = [extended(problem, graphs, search, e, limit, still) for e in explanations[: config.candidates]]
        best = at_once(lambda e: divided(problem, graphs, e, limit, still), best)
        explanations = ranked(search, best + explanations[config.candidates :])
        lap("labels", 0.95)
    if not explanations:
        nothing = [torch.ones(len(s), 1) for s in problem.surfels]
        explanations = [Explanation(Motions.empty(), Labelling(nothing, nothing))]
    candidates = [describe(problem, e, start, end) for e in explanations]
    best = candidates[0]
    out = Discovery(
        motions=best.motions,
        surfels=best.surfels,
        probability=best.probability,
        score=best.score,
        labels_start=best.labels_start,
        labels_end=best.labels_end,
        candidates=candidates,
        diagnostics=figures | {"seconds": seconds},
        problem=problem,
        graphs=graphs,
        search=search,
    )
    out.margin_start = best.label_points(start.points, start.colours, 0)[1]
    out.margin_end = best.label_points(end.points, end.colours, 1)[1]
    out.evidence_start, out.evidence_end = (nearest_evidence(problem, e.points, s) for s, e in enumerate((start, end)))
    out.diagnostics["candidates"] = [
        {
            "score": round(c.score, 4),
            "parts": [(m.type, round(m.amount, 4), round(m.confidence, 3)) for m in c.motions],
        }
        for c in candidates
    ]
    lap("description", 1.0)
    return out


def searched(problem: Problem, axes: Tensor, limit: int) -> tuple[Search, list[Motions]]:
    """A search among all motions about ``axes`` [D, 3], and the sets of motions that it found, best first."""
    search = Search(problem, sweep(problem, axes), limit, problem.config.part_cost)
    solutions = search.solve()
    solutions += search.alternatives(solutions)
    found = [search.pool.motions[torch.tensor(chosen)] for value, chosen in solutions if value > 0 and chosen]
    return search, found
