"""Which step of the search for parts loses which joint? A bench tool that reads ground truth, which no phase may.

    python bench/search_steps.py RUN... [--zoo DIR] [--out FILE]

RUN holds the single states of a scene (``p2gs fit ... --only registration``). The search on surfaces is run anew, with
this build's defaults. A line of JSON per run goes to FILE: for each true joint, how far from it (rms displacement of
the moved surface, internal units) is the nearest motion that was swept ("swept"), of those proposed once all other true
motions are known ("last") and first of all ("first"), and of the pool in the end, with what explanations fitted added
to it ("pool"). And the search's value (high wins) of the true set and of its best one with the number of parts, and
the surfaces' energy (low wins) of the true set and of each explanation.
"""

from __future__ import annotations

import torch
from gates import true_motions
from ladder import Case, of_found, runs_parser, write_rows

from p2gs.motion.discovery import as_motions, discover, surface_energy
from p2gs.motion.discovery.rigid import Motions
from p2gs.motion.discovery.search import FIRST


def nearest(truth: Motions, probe: torch.Tensor, motions: Motions) -> float | None:
    """How far the nearest of ``motions`` moves the points [P, 3] from where ``truth``, one motion, does; None where
    there are none."""
    return round(float(truth.swept(probe, motions).min()), 3) if len(motions) else None


def steps(case: Case) -> dict:
    """A run's line."""
    config = case.cfg.phases["discovery"].config
    found = discover(*case.evidence(), case.cfg.num_parts, config.search, case.cfg.seed)
    transforms, types = true_motions(case)
    explained = [round(surface_energy(found, *of_found(c.motions)), 4) for c in found.candidates if c.motions]
    row: dict = {"name": case.name, "energy": [round(surface_energy(found, transforms, types), 4), explained]}
    search = found.search
    if search is None:  # nothing moved
        return row
    pool, truth = search.pool.motions, as_motions(transforms, types)
    best = next(iter(search.trace[-1]["sets"]), None) if search.trace else None
    rows = search.pool.add(truth).tolist()
    row["value"] = [round(search.value(rows), 4), best]
    row["joints"] = []
    for k, kind in enumerate(types):
        one, others = truth[k : k + 1], [r for i, r in enumerate(rows) if i != k]
        last, first = (search.propose(chosen, *FIRST)[0] for chosen in (others, []))
        asked = {"swept": search.swept.motions, "last": last, "first": first, "pool": pool}
        row["joints"].append({"type": kind} | {name: nearest(one, search.probe, m) for name, m in asked.items()})
    return row


def main() -> None:
    write_rows(runs_parser(__doc__.splitlines()[0]).parse_args(), steps)


if __name__ == "__main__":
    main()
