"""``p2gs table``: a bench's results as files: the paper's tables, every run, every test, and one page with all of
it."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Iterator, Optional

from p2gs.bench import plots, write
from p2gs.bench.grids import Entry, Grid, Row, fill, mark_best, preset_of, summarize
from p2gs.bench.published import CHAMFER, METRICS, SEEN, PaperTable, paper_table
from p2gs.bench.results import Results, collect
from p2gs.bench.significance import PAIRS, published_section
from p2gs.bench.stats import Comparison, Sample, printed, sample, welch
from p2gs.types import UserError

GENERIC = ("ang", "pos", "motion", *CHAMFER, *SEEN, "psnr", "ssim", "lpips", "penetration", "extra", "spare", "minutes")


@dataclass(frozen=True)
class Test:
    """a against b on one object and metric."""

    table: str
    object: str
    metric: str
    a: str
    b: str
    sample_a: Sample
    sample_b: Sample
    result: Comparison

    @property
    def verdict(self) -> str:
        return self.result.verdict(METRICS[self.metric].higher_is_better)


def write_tables(folder: Path | str, names: Optional[list[str]] = None, out: Optional[Path | str] = None) -> list[Path]:
    """Write the tables of a bench folder to ``out`` (default BENCH/tables); returns the files.

    names: tables of the paper; by default those that the bench names. A summary with all settings and objects is always
    made. Raises UserError for a folder that is no bench's, an unknown table, or a table none of whose rows the bench
    has run.
    """
    results = collect(folder)
    target = Path(out) if out is not None else Path(folder) / "tables"
    tables = [paper_table(name) for name in (names if names is not None else results.tables)]
    for table in tables:
        if not set(table.ours) & set(results.settings):
            rows, have = ", ".join(table.ours), ", ".join(results.settings)
            raise UserError(f"{table.name}: its rows are the settings {rows}; this bench has {have}")
    target.mkdir(parents=True, exist_ok=True)
    files, sections, tests = [], [], []
    for name, grids in [("summary", [summary(results)]), *((t.name, fill(t, results)) for t in tables)]:
        text = "\n".join(write.markdown(g) for g in grids)
        files += [
            save(target / f"{name}.md", text),
            save(target / f"{name}.tex", "\n".join(write.latex(g) for g in grids)),
        ]
        write.write_csv(target / f"{name}.csv", grids)
        files.append(target / f"{name}.csv")
        drawn = plots.plot(target / f"{name}.png", grids)
        files += [target / f"{name}.png"] if drawn else []
        sections.append(text + (f"\n![{name}]({name}.png)\n" if drawn else ""))
    for table in tables:
        tests += [*against_paper(table, results), *between_settings(table, results)]
    files += [write_runs(target / "runs.csv", results), write_tests(target / "tests.csv", tests)]
    published = [published_section()] if set(PAIRS) & {t.name for t in tables} else []
    page = "\n".join(
        [
            head(results),
            *sections,
            significance(tests),
            *published,
            notes(results, any(p.suffix == ".png" for p in files)),
        ]
    )
    return [save(target / "index.md", page), *files]


def save(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def summary(results: Results) -> Grid:
    """Settings x objects with every metric that any run has."""
    metrics = [m for m in GENERIC if any(r.values.get(m) is not None for r in results.runs)]
    rows = []
    for column in results.columns:
        for setting in results.settings:
            runs = [r for r in results.runs if r.column == column and r.setting == setting]
            if runs:
                rows.append(Row([column, setting], [summarize(runs, column, m) for m in metrics], "ours"))
        mine = [r for r in results.runs if r.column == column]
        floors = {m: sample([r.floors[m] for r in mine if m in r.floors]) for m in metrics}
        if any(floors.values()):
            rows.append(
                Row(
                    [column, "sampling floor"],
                    [Entry(m, column, s.mean if (s := floors[m]) else None) for m in metrics],
                    "floor",
                )
            )
    mark_best(rows)
    title = f"{results.name}: all runs{preset_of(results)}"
    return Grid("summary", title, ["Object", "Setting"], [METRICS[m].title for m in metrics], rows)


# -- tests ------------------------------------------------------------------------------------------------------------


def ours(results: Results, setting: str, column: str, metric: str) -> Optional[Sample]:
    """Over seeds; None where a joint was lost in any run (an error of the others says nothing then)."""
    runs = [r for r in results.runs if r.setting == setting and r.column == column]
    if any(r.failed.get(metric, (0, 0))[0] for r in runs):
        return None
    return sample([v for r in runs if (v := r.values.get(metric)) is not None])


def against_paper(table: PaperTable, results: Results) -> Iterator[Test]:
    """Each of our settings that is a method of its own against every published row that prints a spread."""
    for setting in (s for s in table.ours if s in results.settings and table.ours[s] is None):
        for p in table.numbers.values():
            mine = ours(results, setting, p.object, p.metric)
            if mine is None or p.value is None or p.std is None:
                continue
            result = welch(mine, printed(p.value, p.std, METRICS[p.metric].digits))
            if result is not None:
                yield Test(
                    table.name, p.object, p.metric, f"p2gs {setting}", p.row, mine, Sample(p.value, p.std, 3), result
                )


def between_settings(table: PaperTable, results: Results) -> Iterator[Test]:
    """Each of our settings against the table's reference setting."""
    if table.reference not in results.settings:
        return
    for setting in (s for s in table.ours if s in results.settings and s != table.reference):
        for column in results.columns:
            for metric in table.metrics:
                a, b = ours(results, setting, column, metric), ours(results, table.reference, column, metric)
                result = welch(a, b) if a is not None and b is not None else None
                if a is not None and b is not None and result is not None:
                    yield Test(table.name, column, metric, f"p2gs {setting}", f"p2gs {table.reference}", a, b, result)


def write_tests(path: Path, tests: list[Test]) -> Path:
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow("table object metric a b mean_a std_a n_a mean_b std_b n_b t degrees p verdict".split())
        for x in tests:
            a, b, r = x.sample_a, x.sample_b, x.result
            out.writerow(
                [
                    x.table,
                    x.object,
                    x.metric,
                    x.a,
                    x.b,
                    a.mean,
                    a.std,
                    a.n,
                    b.mean,
                    b.std,
                    b.n,
                    r.t,
                    r.degrees,
                    r.p,
                    x.verdict,
                ]
            )
    return path


def significance(tests: list[Test]) -> str:
    """Counts by pair of methods."""
    if not tests:
        return (
            "## Significance\n\nNo pair of methods has a spread on both sides (give at least two seeds), so "
            "nothing was tested.\n"
        )
    counts: dict[tuple[str, str, str], Counter] = {}
    for x in tests:
        counts.setdefault((x.table, x.a, x.b), Counter())[x.verdict] += 1
    lines = [
        "## Significance",
        "",
        "Welch's t-test, two-sided, p < 0.05, over object-metric pairs in which every joint was found. Not corrected "
        "for their number.",
        "A published spread of 0.00 is taken as half its last digit, so equal digits do not become certainty.",
        "",
        "| Table | Method | Against | better | no difference | worse |",
        "|---|---|---|---:|---:|---:|",
    ]
    for (table, a, b), c in counts.items():
        lines.append(f"| {table} | {a} | {b} | {c['better']} | {c['no difference']} | {c['worse']} |")
    return "\n".join(lines) + "\n"


# -- the page ---------------------------------------------------------------------------------------------------------


def write_runs(path: Path, results: Results) -> Path:
    """Every run's numbers."""
    metrics = [m for m in METRICS if any(r.values.get(m) is not None for r in results.runs)]
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["object", "column", "setting", "seed", "status", *metrics, "joints_lost", "joints", "error"])
        for r in results.runs:
            values = ["" if r.values.get(m) is None else r.values[m] for m in metrics]
            out.writerow(
                [r.object, r.column, r.setting, r.seed, r.status, *values, *r.failed.get("ang", (0, 0)), r.error or ""]
            )
    return path


def head(results: Results) -> str:
    count = Counter(r.status for r in results.runs)
    seeds = sorted({r.seed for r in results.runs})
    about = ", ".join(f"{k} {v}" for k, v in results.about.items() if v and k != "command")
    states = ", ".join(f"{n} {status}" for status, n in count.items())
    return (
        f"# {results.name}\n\n{len(results.runs)} runs ({states}), seeds {', '.join(map(str, seeds))}; p2gs {about}.\n"
    )


def notes(results: Results, plotted: bool) -> str:
    """How to read the tables, and what failed."""
    lines = [
        "## Notes",
        "",
        "- Mean ± standard deviation over seeds. Ang Err in degrees; Pos Err in tenths of the scene's unit, a "
        "prismatic joint",
        "  counting as 0 (as in the published tables); Motion Err in degrees or units, averaged over both kinds of "
        "joint;",
        "  Chamfer distances squared, both directions, x1000.",
        "- F k/n: k of n joints (over all seeds) were not found or have the wrong type; the number beside it is the "
        "mean of the others.",
        "- Best of each object and metric in bold, as printed; numbers beside an F do not compete.",
        "- Sampling floor: what the true surface scores against another sampling of itself; differences below it "
        "mean nothing.",
        "- Times are of the machine that ran the bench; the published ones are of a GPU.",
    ]
    if not plotted:
        lines.append("- No plots: matplotlib is not installed.")
    broken = [r for r in results.runs if r.status == "failed"]
    if broken:
        lines += [
            "",
            "## Runs that failed",
            "",
            *(f"- {r.object} {r.setting} seed {r.seed}: {r.error}" for r in broken),
        ]
    return "\n".join(lines) + "\n"
