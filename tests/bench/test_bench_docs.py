"""docs/benchmarks.md says what the program does: its commands parse, its YAML is a bench."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from p2gs.app import parser
from p2gs.bench import peers, scaling
from p2gs.bench.plan import read_bench
from p2gs.bench.published import table_names

PAGE = (Path(__file__).parents[2] / "docs" / "benchmarks.md").read_text()


def blocks(kind: str) -> list[str]:
    return re.findall(rf"```{kind}\n(.*?)```", PAGE, re.S)


def commands() -> list[str]:
    return [
        line.split("#")[0].strip() for block in blocks("bash") for line in block.splitlines() if line.startswith("p2gs")
    ]


@pytest.mark.parametrize("command", commands())
def test_commands_parse(command):
    words = shlex.split(command)[1:]
    own = {"scaling": scaling, "peers": peers}.get(words[1] if words[0] == "bench" else "")
    args, rest = own.options().parse_known_args(words[2:]) if own else parser().parse_known_args(words)
    assert (
        not rest
        or (own or args.command in ("fit", "bench"))
        and rest[0].startswith("--phases.")
        or rest[0].startswith("--data.")
    )
    for name in getattr(args, "config", []):
        assert (Path(__file__).parents[2] / "configs" / name).is_file(), name


def test_the_yaml_is_read(tree, tmp_path):
    assert len(blocks("yaml")) == 3
    (tmp_path / "bench.yaml").write_text(blocks("yaml")[0])
    bench = read_bench([str(tmp_path / "bench.yaml")], ["--root", str(tree)])
    bench.check_settings()
    assert len(bench.cells) == 4 * 2 * 3
    for cluster in blocks("yaml")[1:]:
        (tmp_path / "cluster.yaml").write_text(cluster)
        options = read_bench(
            [str(tmp_path / "bench.yaml"), str(tmp_path / "cluster.yaml")], ["--root", str(tree)]
        ).options
        assert options.executor in yaml.safe_load(cluster).values()


def test_every_table_and_bench_is_on_the_page():
    assert set(re.findall(r"tab:(\w+)", PAGE)) == set(table_names())
    files = {p.name for p in (Path(__file__).parents[2] / "configs" / "bench").glob("*.yaml")}
    assert set(re.findall(r"bench/(\w+\.yaml)", PAGE)) == files
