"""The paper's tables filled with a bench's results: grids of entries, in the layout of each table."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Callable, Iterator, Optional, Sequence

from p2gs.bench.published import CHAMFER, METRICS, PaperTable, footnotes
from p2gs.bench.results import Results, Run
from p2gs.bench.stats import PUBLISHED_RUNS, Sample, sample

OURS = "p2gs"


@dataclass
class Entry:
    """One number. text: instead of a number ("-": not defined, "F": nothing right, "": not run).  lost: joints not
    found, of how many.
    std: None where there is one run or none is printed.  notes: numbers of footnotes.  best: least (or largest) of its
    metric and object.
    """

    metric: str
    object: str
    mean: Optional[float] = None
    std: Optional[float] = None
    n: int = 0
    text: str = ""
    lost: tuple[int, int] = (0, 0)
    notes: list[int] = field(default_factory=list)
    best: bool = False
    extra_digits: int = 0

    @property
    def digits(self) -> int:
        return METRICS[self.metric].digits + self.extra_digits


@dataclass
class Row:
    """labels, one for each of the grid's label columns.  kind: paper, ours or floor."""

    labels: list[str]
    entries: list[Entry]
    kind: str


@dataclass
class Grid:
    """A table. heads: titles of the label columns.  columns: titles of the entries'.  footnotes: sentences by
    number."""

    name: str
    title: str
    heads: list[str]
    columns: list[str]
    rows: list[Row]
    footnotes: dict[int, str] = field(default_factory=dict)


class Filled:
    """A paper table and a bench's results, by (row label, object, metric). objects: columns of the paper, then those it
    does not have."""

    def __init__(self, table: PaperTable, results: Results):
        self.table, self.results = table, results
        self.used: dict[int, str] = {}
        settings = [s for s in table.ours if s in results.settings]
        self.settings = settings
        self.runs: dict[tuple[str, str], list[Run]] = {}
        for run in results.runs:
            if run.setting in settings:
                self.runs.setdefault((run.setting, run.column), []).append(run)
        own = [c for c in results.columns if any(column == c for _, column in self.runs)]
        self.overlap = [c for c in own if c in table.objects]
        self.foreign = [c for c in own if c not in table.objects]

    def lines(self) -> list[tuple[str, str, Callable[[str, str], Entry], str]]:
        """The method rows in order, (label, key, entry of (object, metric), kind): each row of the paper, ours below
        it; our own last."""
        out = []
        for row in self.table.rows:
            out.append((row, row, lambda o, m, r=row: self.paper(r, o, m), "paper"))
            for setting in self.settings:
                if self.table.ours[setting] == row:
                    out.append((f"{row} ({OURS})", setting, lambda o, m, s=setting: self.mine(s, o, m), "ours"))
        for setting in self.settings:
            if self.table.ours[setting] is None:
                label = OURS if setting == "full" else f"{OURS} {setting}"
                out.append((label, setting, lambda o, m, s=setting: self.mine(s, o, m), "ours"))
        return out

    def paper(self, row: str, object: str, metric: str) -> Entry:
        p = self.table.numbers.get((row, object, metric))
        if p is None:
            return Entry(metric, object)
        notes = []
        for i, note in enumerate(footnotes()):
            if note.applies(self.table.name, row, object, metric):
                notes.append(i)
                self.used[i] = note.text
        if p.value is None:
            return Entry(metric, object, text=p.text, notes=notes)
        digits = len(p.text.partition(".")[2]) - METRICS[metric].digits
        return Entry(
            metric, object, p.value, p.std, 1 if p.std is None else PUBLISHED_RUNS, notes=notes, extra_digits=digits
        )

    def mine(self, setting: str, object: str, metric: str) -> Entry:
        return summarize(self.runs.get((setting, object), []), object, metric)

    def floor(self, object: str, metric: str) -> Entry:
        """The sampling floor: mean over all runs of the object."""
        runs = [r for (_, column), group in self.runs.items() if column == object for r in group]
        got = sample([r.floors[metric] for r in runs if metric in r.floors])
        return Entry(metric, object, None if got is None else got.mean)

    def has_floor(self, objects: Sequence[str], metric: str) -> bool:
        return metric in CHAMFER and any(self.floor(o, metric).mean is not None for o in objects)


def summarize(runs: Sequence[Run], object: str, metric: str) -> Entry:
    """Mean and spread over seeds of one setting and object; joints lost are summed over the seeds."""
    lost = tuple(sum(r.failed.get(metric, (0, 0))[i] for r in runs) for i in (0, 1))
    got: Optional[Sample] = sample([v for r in runs if (v := r.values.get(metric)) is not None])
    if got is not None:
        return Entry(metric, object, got.mean, got.std, got.n, lost=lost)
    if lost[0] and not (metric == "pos" and any(r.slides_only for r in runs)):
        return Entry(metric, object, text="F", lost=lost)
    return Entry(metric, object, text="-" if any(r.status == "done" for r in runs) else "")


def average(entries: Sequence[Entry], metric: str, object: str = "average") -> Entry:
    """Mean of the entries that have a number; "-" where none has."""
    got = sample([e.mean for e in entries if e.mean is not None])
    lost = tuple(sum(e.lost[i] for e in entries) for i in (0, 1))
    if got is None:
        text = "F" if any(e.text == "F" for e in entries) else "-" if any(e.text for e in entries) else ""
        return Entry(metric, object, text=text, lost=lost)
    return Entry(metric, object, got.mean, None, 1, lost=lost)


def mark_best(rows: Sequence[Row]) -> None:
    """The best entry of each (object, metric), as printed, ties included; what lost a joint is not in the running."""
    groups: dict[tuple[str, str], list[Entry]] = {}
    for row in rows:
        if row.kind != "floor":
            for e in row.entries:
                if e.mean is not None and not e.lost[0]:
                    groups.setdefault((e.object, e.metric), []).append(e)
    for (_, metric), entries in groups.items():
        if len(entries) < 2:
            continue
        best = (max if METRICS[metric].higher_is_better else min)(round(e.mean, e.digits) for e in entries)
        for e in entries:
            e.best = round(e.mean, e.digits) == best


# -- layouts ----------------------------------------------------------------------------------------------------------


def fill(table: PaperTable, results: Results) -> list[Grid]:
    """The table's grids: one, or two where the bench has none of the paper's objects (ours, then the paper's own)."""
    filled = Filled(table, results)
    if filled.overlap or not filled.foreign or table.layout == "average":
        return [_grid(filled, table.objects, filled.foreign, table.title)]
    ours = _grid(filled, [], filled.foreign, table.title + ": objects that the paper does not have")
    ours.rows = [r for r in ours.rows if r.kind != "paper"]
    for row in ours.rows:
        row.labels = [label.removesuffix(f" ({OURS})") for label in row.labels]
    paper = _grid(
        Filled(table, Results(results.name, [], [], [], [], {})), table.objects, [], table.title + ": as published"
    )
    return [ours, paper]


def preset_of(results: Results) -> str:
    """Words for a title: the preset that p2gs's rows were made with."""
    return f" ({OURS}: preset {results.about['preset']})" if results.about.get("preset") else ""


def _grid(filled: Filled, published: Sequence[str], foreign: Sequence[str], title: str) -> Grid:
    make = {"objects": _objects, "metrics": _metrics, "groups": _groups, "settings": _settings, "average": _average}[
        filled.table.layout
    ]
    heads, columns, rows = make(filled, [*published, *foreign])
    mark_best(rows)
    numbers = {old: new for new, old in enumerate(sorted(filled.used), 1)}
    for row in rows:
        for e in row.entries:
            e.notes = [numbers[i] for i in e.notes]
    notes = {numbers[i]: text for i, text in sorted(filled.used.items())}
    return Grid(filled.table.name, title + preset_of(filled.results), heads, columns, rows, notes)


def _metric_rows(f: Filled, metric: str, objects: Sequence[str]) -> Iterator[Row]:
    for label, _, entry, kind in f.lines():
        yield Row([METRICS[metric].title, label], [entry(o, metric) for o in objects], kind)
    if f.has_floor(objects, metric):
        yield Row([METRICS[metric].title, "sampling floor"], [f.floor(o, metric) for o in objects], "floor")


def _objects(f: Filled, objects: Sequence[str]):
    blocks = f.table.blocks or (tuple(f.table.metrics),)
    columns, rows = list(objects), []
    stacked = [[row for metric in block for row in _metric_rows(f, metric, objects)] for block in blocks]
    # sampling floors make the second block longer: one below the other
    if len(blocks) == 1 or len({len(s) for s in stacked}) > 1:
        return ["Metric", "Method"], columns, [row for s in stacked for row in s]
    columns = [*objects, "Metric", *objects]
    for left, right in zip(*stacked, strict=True):
        title = Entry(right.entries[0].metric, "", text=right.labels[0])
        rows.append(Row(left.labels, [*left.entries, title, *right.entries], left.kind))
    return ["Metric", "Method"], columns, rows


def _metrics(f: Filled, objects: Sequence[str]):
    metrics, rows = f.table.metrics, []
    for o in objects:
        rows += [Row([o, label], [entry(o, m) for m in metrics], kind) for label, _, entry, kind in f.lines()]
        if any(f.has_floor([o], m) for m in metrics):
            rows.append(
                Row([o, "sampling floor"], [f.floor(o, m) if m in CHAMFER else Entry(m, o) for m in metrics], "floor")
            )
    return ["Object", "Method"], [METRICS[m].title for m in metrics], rows


def _groups(f: Filled, objects: Sequence[str]):
    """Objects by group, an average below each; what the paper does not have is grouped by the joints that its runs were
    scored on."""
    metrics, rows = f.table.metrics, []
    slides = {run.column: run.slides_only for run in f.results.runs if run.values}
    for group in f.table.rows:
        members = [o for o in objects if (group, o, metrics[0]) in f.table.numbers and o != "average"]
        members += [
            o
            for o in objects
            if o in f.foreign and o not in members and slides.get(o, False) == (group == "Translation")
        ]
        ours: list[list[Entry]] = []
        for o in members:
            if (group, o, metrics[0]) in f.table.numbers:
                rows.append(Row([group, f"{o}, paper"], [f.paper(group, o, m) for m in metrics], "paper"))
            for setting in f.settings:
                if (setting, o) in f.runs:
                    ours.append([f.mine(setting, o, m) for m in metrics])
                    rows.append(Row([group, f"{o}, {OURS}"], ours[-1], "ours"))
        if "average" in objects:
            rows.append(
                Row([group, "Average, paper"], [_keyed(f.paper(group, "average", m), group) for m in metrics], "paper")
            )
        if ours:
            means = [average([e[i] for e in ours], m, f"average {group}") for i, m in enumerate(metrics)]
            rows.append(Row([group, f"Average, {OURS}"], means, "ours"))
    return ["Category", "Object"], [METRICS[m].title for m in metrics], rows


def _keyed(entry: Entry, group: str) -> Entry:
    entry.object = f"average {group}"
    return entry


def _settings(f: Filled, objects: Sequence[str]):
    rows = []
    mapped = {row: next((s for s in f.settings if f.table.ours[s] == row), None) for row in f.table.rows}
    for o in objects:
        for m in f.table.metrics:
            if o in f.table.objects:
                rows.append(Row([o, METRICS[m].title, "paper"], [f.paper(r, o, m) for r in f.table.rows], "paper"))
            if o in f.overlap or o in f.foreign:
                entries = [f.mine(s, o, m) if s else Entry(m, o) for s in mapped.values()]
                rows.append(Row([o, METRICS[m].title, OURS], entries, "ours"))
                if f.has_floor([o], m):
                    floors = [f.floor(o, m) if s else Entry(m, o) for s in mapped.values()]
                    rows.append(Row([o, METRICS[m].title, "sampling floor"], floors, "floor"))
    return ["Object", "Metric", "Source"], f.table.rows, rows


def _average(f: Filled, objects: Sequence[str]):
    metrics, rows = f.table.metrics, []
    every = [*dict.fromkeys(column for _, column in f.runs)]
    for label, _, entry, kind in f.lines():
        entries = [
            entry("average", m) if kind == "paper" else average([entry(o, m) for o in every], m) for m in metrics
        ]
        rows.append(Row([label, "the paper's objects" if kind == "paper" else f"{len(every)} objects"], entries, kind))
    return ["Setting", "Average over"], [METRICS[m].title for m in metrics], rows
