"""Tables as bar charts. The only file that imports matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Sequence

from p2gs.bench.grids import Entry, Grid
from p2gs.bench.published import METRICS

COLOURS = {
    "paper": ["#c9ccd1", "#a4a9b3", "#7f8794", "#5c6575", "#3c4454"],
    "ours": ["#e8602c", "#f29e4c", "#2a9d8f", "#8ac926", "#6a4c93", "#1982c4", "#ff595e", "#b5838d"],
}


def plot(path: Path, grids: Sequence[Grid]) -> bool:
    """One panel a metric, objects across, a bar a method, logarithmic where the numbers span more than a factor of 30.

    Bars carry the standard deviation; a cross stands where the method failed. False where matplotlib is not installed.
    """
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    panels = [(grid, metric) for grid in grids for metric in METRICS if series(grid, metric)]
    if not panels:
        return False
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    bars = max(len(series(grid, metric)) for grid, metric in panels)
    figure, axes = plt.subplots(
        rows, columns, figsize=(5.5 * columns, 3.6 * rows + 0.4 + 0.12 * bars), squeeze=False, layout="constrained"
    )
    handles = {}
    for axis, (grid, metric) in zip(axes.flat, panels, strict=False):
        draw(axis, grid, metric)
        handles |= {text: handle for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)}
    for axis in list(axes.flat)[len(panels) :]:
        axis.remove()
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=min(len(handles), 2 * columns), fontsize=8
    )
    figure.suptitle(grids[0].title)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return True


def growth(path: Path, panels: dict[str, tuple[Sequence[float], dict[str, Sequence[float]]]]) -> bool:
    """One panel a quantity, (sizes, figure -> values): each figure over the quantity, both logarithmic and as multiples
    of their first, beside what grows in proportion. False where matplotlib is not installed."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(panels), figsize=(4.5 * len(panels), 4), squeeze=False, layout="constrained")
    for axis, (name, (sizes, figures)) in zip(axes.flat, panels.items(), strict=True):
        axis.loglog(sizes, [s / sizes[0] for s in sizes], "--", color="#a4a9b3", label="in proportion")
        for (label, values), colour in zip(figures.items(), COLOURS["ours"], strict=False):
            axis.loglog(sizes, [v / max(values[0], 1e-9) for v in values], "o-", color=colour, label=label)
        axis.set_xlabel(name)
    axes[0, 0].set_ylabel("times the smallest")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return True


def series(grid: Grid, metric: str) -> dict[tuple[str, str], dict[str, Entry]]:
    """(method, kind) -> object -> entry, of the entries that say something."""
    out: dict[tuple[str, str], dict[str, Entry]] = {}
    for row in grid.rows:
        for at, e in enumerate(row.entries):
            if e.metric == metric and e.object and row.kind != "floor" and (e.mean is not None or e.text == "F"):
                settings = len(grid.heads) == 3  # the layout with the settings across
                method = (
                    f"{row.labels[-1]} {grid.columns[at]}" if settings else row.labels[-1].removeprefix(f"{e.object}, ")
                )
                out.setdefault((method, row.kind), {})[e.object] = e
    return out


def draw(axis, grid: Grid, metric: str) -> None:
    """One panel."""
    methods = series(grid, metric)
    there = {o for found in methods.values() for o in found}
    objects = [o for o in dict.fromkeys(e.object for row in grid.rows for e in row.entries) if o in there]
    width = 0.8 / len(methods)
    counts = {"paper": 0, "ours": 0}
    values = [e.mean for found in methods.values() for e in found.values() if e.mean is not None and e.mean > 0]
    # bars stand on a base above zero where the axis is logarithmic: zero is nowhere on it
    base = 0.5 * min(values) if values and max(values) > 30 * min(values) else 0.0
    for i, ((method, kind), found) in enumerate(methods.items()):
        at = [objects.index(o) + (i - (len(methods) - 1) / 2) * width for o in found]
        colour = COLOURS[kind][counts[kind] % len(COLOURS[kind])]
        counts[kind] += 1
        heights = [e.mean or 0.0 for e in found.values()]
        heights = [max(h - base, 0.0) for h in heights]
        up = [e.std or 0.0 for e in found.values()]
        down = [min(s, h) for s, h in zip(up, heights, strict=True)]
        axis.bar(at, heights, width, base, yerr=[down, up], color=colour, label=method, error_kw={"lw": 0.8})
        lost = [x for x, e in zip(at, found.values(), strict=True) if e.text == "F" or e.lost[0]]
        axis.plot(lost, [0.03] * len(lost), "x", color="crimson", transform=axis.get_xaxis_transform())
    if base:
        axis.set_yscale("log")
        axis.set_ylim(bottom=base)
    axis.set_title(
        METRICS[metric].title + (" (higher is better)" if METRICS[metric].higher_is_better else ""), fontsize=10
    )
    axis.set_xticks(range(len(objects)), objects, rotation=30, ha="right", fontsize=8)


def lines(path: Path, series: dict[str, dict[float, float]], x: str, y: str, mark: float) -> bool:
    """One line a name through {x: y}, y logarithmic, with a dashed line at ``mark``. False where matplotlib is not
    installed."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(6.5, 4.2), layout="constrained")
    for (name, points), colour in zip(series.items(), COLOURS["ours"] * len(series), strict=False):
        axis.plot(list(points), [max(v, 1e-3) for v in points.values()], "o-", color=colour, label=name)
    axis.axhline(mark, color="#5c6575", linestyle="--", linewidth=0.8)
    axis.set_yscale("log")
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return True
