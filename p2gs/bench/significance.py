"""The paper's own significance count, taken again: Part2GS against ArtGS over every object and metric that it prints
for both.

The paper (section 4.1): t-tests, n = 3, "a small epsilon (1e-6)", 111 object-metric pairs, of which 83 better, 25
without a significant difference, 3 worse. Its tables print means, and spreads on PARIS only, so the count can be taken
from them in two ways: with spreads as they are printed (at least the epsilon), or with what rounding to two digits
leaves open (half the last digit at least).
"""

from __future__ import annotations

from collections import Counter
from typing import Iterator, Literal

from p2gs.bench.published import METRICS, paper_table
from p2gs.bench.stats import TINY, Sample, printed, welch

PAPER = {"better": 83, "no difference": 25, "worse": 3}
PAIRS = ("main_result", "complex_main_result")
OURS, THEIRS = "Part2GS", "ArtGS"
Spread = Literal["printed", "rounding"]


def published_verdicts(spread: Spread) -> Iterator[tuple[str, str, str, str]]:
    """(table, object, metric, verdict of Part2GS against ArtGS) by Welch's test at p < 0.05, n = 3 on both sides.

    spread: "printed" takes a missing or zero spread as the paper's epsilon of 1e-6; "rounding" as half the last printed
    digit.
    """
    for name in PAIRS:
        table = paper_table(name)
        for (row, object, metric), mine in table.numbers.items():
            other = table.numbers.get((THEIRS, object, metric))
            if row != OURS or other is None or mine.value is None or other.value is None:
                continue
            numbers = ((mine.value, mine.std or 0.0), (other.value, other.std or 0.0))
            if spread == "printed":
                a, b = (Sample(value, max(std, TINY), 3) for value, std in numbers)
            else:
                a, b = (printed(value, std, METRICS[metric].digits) for value, std in numbers)
            found = welch(a, b)
            assert found is not None  # both have a spread
            yield name, object, metric, found.verdict(METRICS[metric].higher_is_better)


def counts(spread: Spread) -> Counter:
    """How many pairs are better, without difference, worse."""
    return Counter(verdict for *_, verdict in published_verdicts(spread))


def published_section() -> str:
    """Markdown: the paper's count and ours beside it."""
    rows = [
        ("as the paper states it", PAPER),
        ("from its tables, spreads as printed, 1e-6 at least", counts("printed")),
        ("from its tables, half the last digit at least", counts("rounding")),
    ]
    lines = [
        "## The paper's own test: Part2GS against ArtGS, both as published",
        "",
        "Welch's t-test, two-sided, p < 0.05, n = 3. ArtGS-Multi and DTA-Multi print no spreads; there the least "
        "spread decides.",
        "",
        "| Count | pairs | better | no difference | worse |",
        "|---|---:|---:|---:|---:|",
    ]
    for label, c in rows:
        lines.append(f"| {label} | {sum(c.values())} | {c['better']} | {c['no difference']} | {c['worse']} |")
    return "\n".join(lines) + "\n"
