"""Is the truth what the surfaces' energy likes best? A bench tool that reads ground truth, which no phase may.

    python bench/rivals.py RUN... [--zoo DIR] [--out FILE]

RUN holds the single states of a scene (``p2gs fit ... --only registration``). What discovery finds tells little of its
energy, as its search may miss what is lower. So a search that does nothing but lower the energy goes on from the truth
and from the explanations found: a part less, one more, another motion in a part's place, of what the pool of motions
has for what is left wrong. A line of JSON per run goes to FILE: energy, parts and how many of them are there, at the
truth (as it is, or fitted, whichever is lower), where the search came from there, and at the best that it found; and of
each, which shares of the moved surface meet what: seen through ("through"), another's surface ("elsewhere"), their own
in another colour ("colour"), the plate's other side that all views hide ("side"), hidden, or nobody's ("lost").
"""

from __future__ import annotations

from typing import Iterator

import torch
from gates import true_motions
from ladder import Case, of_found, runs_parser, write_rows

from p2gs.motion.discovery import as_motions, discover
from p2gs.motion.discovery.explanations import total_score
from p2gs.motion.discovery.finish import Explanation, settle_parts
from p2gs.motion.discovery.hypotheses import static_axes
from p2gs.motion.discovery.labels import Labelling, label
from p2gs.motion.discovery.proposals import sided, stacked
from p2gs.motion.discovery.rigid import Motions, without
from p2gs.motion.discovery.verify import light_of, meetings, violation

TRIED = 6  # motions tried in a part's place, and of all tries those that are fitted
PROPOSED = 48, 8  # motions looked at and kept for what a set of motions leaves over
THERE = {"axis_angle": 5.0, "axis_position": 0.5, "turn": 5.0, "slide": 0.05}  # bounds of a part that is there


class Rivals:
    """The search for explanations of lower energy, amid what ``discover`` found."""

    def __init__(self, found, limit: int):
        self.problem, self.graphs, self.search, self.limit = found.problem, found.graphs, found.search, limit
        self.axes = static_axes(found.problem)

    def scored(self, motions: Motions, labelling: Labelling) -> Explanation:
        """With its energy."""
        return Explanation(motions, labelling, total_score(self.problem, motions, labelling))

    def explained(self, motions: Motions) -> Explanation:
        """The motions with their best labels and energy."""
        return self.scored(motions, label(self.problem, motions, self.graphs))

    def fitted(self, one: Explanation) -> Explanation:
        """The same, each motion fitted to its points, where that lowers the energy."""
        after = self.scored(*settle_parts(self.problem, self.graphs, one.motions, self.axes))
        return min(one, after, key=lambda e: e.score)

    def moves(self, one: Explanation) -> Iterator[Explanation]:
        """One part more, less, and another in its place."""
        yield from self.promising(one)
        for k in range(len(one.motions)):
            rest = self.explained(without(one.motions, k))
            if len(rest.motions):
                yield rest
            yield from self.promising(rest)

    def promising(self, rest: Explanation) -> Iterator[Explanation]:
        """``rest`` with one motion more, up to the limit, of those by which most of what it leaves wrong would be
        right: of the pool, to which the search's proposals for what it leaves over are added."""
        if len(rest.motions) >= self.limit:
            return
        p, pool, left = self.problem, self.search.pool, self.left_wrong(rest)
        pool.add(self.search.propose(pool.add(rest.motions).tolist(), *PROPOSED)[0])
        costs = [p.cost(pool.motions, s, p.samples[s])[0] for s in (0, 1)]
        saved = pool.mean([(x - c).clamp_min(0) for x, c in zip(left, costs, strict=True)])
        for k in saved.topk(min(TRIED, len(pool.motions))).indices:
            yield self.explained(Motions.cat([rest.motions, pool.motions[k[None]]]))

    def left_wrong(self, rest: Explanation) -> list[torch.Tensor]:
        """Violation [P] of each state's samples."""
        light = light_of(self.problem, rest.motions, rest.labelling)
        return [
            violation(self.problem, rest.motions, rest.labelling, s, self.problem.samples[s], light=light)
            for s in (0, 1)
        ]

    def lowest(self, one: Explanation) -> Explanation:
        """Where moves lead to while the energy falls."""
        while len(one.motions):
            best = [self.fitted(e) for e in sorted(self.moves(one), key=lambda e: e.score)[:TRIED]]
            least = min(best, key=lambda e: e.score, default=one)
            if least.score >= one.score:
                break
            one = least
        return one

    def shares(self, one: Explanation) -> dict[str, float]:
        """Which shares of the moved surface meet what."""
        p, light = self.problem, light_of(self.problem, one.motions, one.labelling)
        names = ("through", "elsewhere", "colour", "side", "hidden", "lost")
        total, mass = torch.zeros(len(names)), 0.0
        for s in (0, 1):
            index = p.moved[s].nonzero()[:, 0]
            met, w = meetings(p, one.motions, one.labelling, s, index, light=light), p.trust[s][index]
            asked = ~met.lost
            seen, unlike = asked & met.shown, (1 - met.through) * (asked & met.shown & ~met.like)
            blocked = asked & ~met.shown
            kinds = [met.through * seen, unlike * ~met.own, unlike * met.own]
            kinds += [blocked & met.other_side, blocked & ~met.other_side, met.lost]
            total += torch.stack([k.float() @ w for k in kinds])
            mass += float(w.sum())
        return {n: round(float(x) / max(mass, 1e-9), 3) for n, x in zip(names, total, strict=True)}


def rivals(case: Case) -> dict:
    """A run's line."""
    config = case.cfg.phases["discovery"].config
    found = discover(*case.evidence(), case.cfg.num_parts, config.search, case.cfg.seed)
    row: dict = {"name": case.name, "of": len(case.truth.joints)}
    if found.search is None:  # nothing moved
        return row
    rival = Rivals(found, config.search.max_parts - 1)
    truth = rival.fitted(rival.explained(sided(found.problem, as_motions(*true_motions(case)))))
    starts = [as_motions(*of_found(c.motions)) for c in found.candidates if c.motions]
    ends = [rival.lowest(rival.explained(sided(found.problem, start))) for start in starts]
    best = min(ends, key=lambda e: e.score, default=truth)
    for name, one in (("truth", truth), ("from the truth", rival.lowest(truth)), ("found", best)):
        there = case.score(*stacked(one.motions), THERE)["right"]
        row[name] = {"energy": round(one.score, 4), "parts": len(one.motions), "there": there}
        row[name]["meets"] = rival.shares(one)
    return row


def main() -> None:
    write_rows(runs_parser(__doc__.splitlines()[0]).parse_args(), rivals)


if __name__ == "__main__":
    main()
