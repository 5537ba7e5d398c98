"""Every published cell, all 1,188 of them, against the paper's own source, read in the order in which it is printed."""

import re
from pathlib import Path

import pytest

from p2gs.bench.published import paper_table, table_names

# of these a row's first number is its label: K, sigma, p
LABELLED = {"k_ablation", "repel_noise_robustness", "repel_exponent_ablation"}
NUMBER = re.compile(r"\d+(?:\.\d+)?|F|--?")
COLOURS = {"": "", "best": "cayenne", "all modules": "cayenne", "severe": "espresso"}  # of our marks


@pytest.fixture(scope="module")
def source() -> str:
    """The paper's LaTeX beside the repository, without comments; skips where it is not there."""
    path = Path(__file__).resolve().parents[3] / "shared" / "paper" / "part2gs.tex"
    if not path.is_file():
        pytest.skip(f"no paper at {path}")
    return re.sub(r"(?<!\\)%.*", "", path.read_text())


def printed(source: str, name: str) -> list[tuple[str, str, str]]:
    """(number, spread, colour) of a table's cells, in reading order; labels in front of a row left out."""
    body = source.split(rf"\label{{tab:{name}}}")[1].split(r"\end{table")[0]
    found = []
    for line in re.split(r"\\\\", body):
        row = [cell for text in line.split("&") if (cell := read_cell(text)) is not None]
        found += row[1:] if name in LABELLED else row
    return found


def read_cell(text: str):
    """A cell that is nothing but a number, a dash or F; None for any other."""
    colour = re.search(r"\\cellcolor\{(\w+)", text)
    bare = re.sub(r"\\(cellcolor|multirow|cmidrule|cline|setlength)(\([^)]*\)|\{[^{}]*\})*", "", text)
    bare = re.sub(r"\\(hline|midrule|bottomrule|toprule|textbf|underline)\b|[{}$\s]", "", bare)
    bare, _, spread = bare.partition(r"_\pm")
    if not NUMBER.fullmatch(bare):
        return None
    return bare.replace("--", "-"), spread, "" if colour is None else colour.group(1)


@pytest.mark.parametrize("name", table_names())
def test_every_cell_is_the_papers(name, source):
    cells = [(p.text, "" if p.std is None else p.std, COLOURS[p.marked]) for p in paper_table(name).numbers.values()]
    theirs = [(text, float(spread) if spread else "", colour) for text, spread, colour in printed(source, name)]
    assert len(theirs) == len(cells) and len(cells) > 0
    wrong = [
        (key, mine, paper)
        for key, mine, paper in zip(paper_table(name).numbers, cells, theirs, strict=True)
        if mine != paper
    ]
    assert not wrong, wrong[:5]


def test_all_of_them_are_looked_at():
    assert sum(len(paper_table(name).numbers) for name in table_names()) == 1188
