"""Grids as Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Callable, Sequence

from p2gs.bench.grids import Entry, Grid, Row


def number(e: Entry) -> tuple[str, str]:
    """Mean and spread as printed; the spread is empty where there is none."""
    return f"{e.mean:.{e.digits}f}", "" if e.std is None else f"{e.std:.{e.digits}f}"


def lost(e: Entry) -> str:
    """`` F 1/12``: joints that were not found, of how many."""
    return f" F {e.lost[0]}/{e.lost[1]}" if e.lost[0] else ""


def markdown_entry(e: Entry) -> str:
    if e.mean is None:
        text = e.text + (lost(e).removeprefix(" F") if e.text == "F" else "")
    else:
        mean, std = number(e)
        text = f"{mean} ± {std}" if std else mean
        text = (f"**{text}**" if e.best else text) + lost(e)
    return text + (f"<sup>{','.join(map(str, e.notes))}</sup>" if e.notes else "")


def latex_entry(e: Entry) -> str:
    if e.mean is None:
        text = escape(e.text) + (lost(e).removeprefix(" F") if e.text == "F" else "")
    else:
        mean, std = number(e)
        text = f"{mean}_{{\\pm {std}}}" if std else mean
        text = (f"$\\mathbf{{{text}}}$" if e.best else f"${text}$") + lost(e)
    return text + (f"\\textsuperscript{{{','.join(map(str, e.notes))}}}" if e.notes else "")


def escape(text: str) -> str:
    """For LaTeX text."""
    for a, b in (
        ("\\", "\\textbackslash{}"),
        ("&", "\\&"),
        ("%", "\\%"),
        ("_", "\\_"),
        ("#", "\\#"),
        ("$", "\\$"),
        ("±", "$\\pm$"),
    ):
        text = text.replace(a, b)
    return text


def labels(rows: Sequence[Row], cell: Callable[[str], str]) -> list[list[str]]:
    """Row labels, the first column only where it changes."""
    out, before = [], None
    for row in rows:
        out.append([cell(row.labels[0]) if row.labels[0] != before else "", *map(cell, row.labels[1:])])
        before = row.labels[0]
    return out


def markdown(grid: Grid) -> str:
    """A Markdown table with its title and footnotes."""
    heads = [*grid.heads, *grid.columns]
    lines = [
        f"**{grid.title}**",
        "",
        "| " + " | ".join(heads) + " |",
        "|" + "---|" * len(grid.heads) + "---:|" * len(grid.columns),
    ]
    for names, row in zip(labels(grid.rows, str), grid.rows, strict=True):
        style = (lambda t: f"*{t}*" if t else "") if row.kind == "floor" else str
        lines.append("| " + " | ".join([*map(style, names), *(style(markdown_entry(e)) for e in row.entries)]) + " |")
    if grid.footnotes:
        lines += ["", *(f"<sup>{n}</sup> {text}  " for n, text in grid.footnotes.items())]
    return "\n".join(lines) + "\n"


def latex(grid: Grid) -> str:
    """A LaTeX table (needs booktabs and graphicx). The best numbers are bold."""
    first = None
    body = []
    for names, row in zip(labels(grid.rows, escape), grid.rows, strict=True):
        if first is not None and names[0]:
            body.append("\\midrule")
        first = row
        body.append(" & ".join([*names, *map(latex_entry, row.entries)]) + " \\\\")
    notes = " ".join(f"\\textsuperscript{{{n}}} {escape(text)}" for n, text in grid.footnotes.items())
    heads = " & ".join(f"\\textbf{{{escape(h)}}}" for h in (*grid.heads, *grid.columns))
    return "\n".join(
        [
            "% made by p2gs table; needs booktabs and graphicx",
            "\\begin{table*}[t]",
            "\\centering",
            f"\\caption{{{escape(grid.title)}.{' ' + notes if notes else ''}}}",
            f"\\label{{tab:p2gs_{grid.name}}}",
            "\\resizebox{\\textwidth}{!}{%",
            f"\\begin{{tabular}}{{{'l' * len(grid.heads)}{'c' * len(grid.columns)}}}",
            "\\toprule",
            f"{heads} \\\\",
            "\\midrule",
            *body,
            "\\bottomrule",
            "\\end{tabular}}",
            "\\end{table*}",
            "",
        ]
    )


def write_csv(path: Path, grids: Sequence[Grid]) -> None:
    """Every number in full, one a line."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(
            ["table", "row", "source", "object", "metric", "mean", "std", "n", "text", "joints_lost", "joints", "best"]
        )
        for grid in grids:
            for row in grid.rows:
                for e in row.entries:
                    if e.mean is not None or (e.text and e.object):
                        values = [
                            " / ".join(row.labels),
                            row.kind,
                            e.object,
                            e.metric,
                            e.mean,
                            e.std,
                            e.n,
                            e.text,
                            *e.lost,
                            int(e.best),
                        ]
                        out.writerow([grid.name, *("" if v is None else v for v in values)])
