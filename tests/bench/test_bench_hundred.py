"""A hundred runs of a stand-in through each executor, a node of Ray's killed half way: none lost, none counted twice,
the same tables. With real runs: tests/faults/test_hundred_runs.py."""

import csv
import io
import threading
from collections import Counter
from contextlib import contextmanager, redirect_stdout

import pytest

from p2gs.bench.cell import is_done, read_record
from p2gs.bench.plan import read_bench
from p2gs.bench.report import write_tables
from p2gs.bench.runner import run_bench

EXECUTORS = {
    "local": "processes: 4\n",
    "slurm": "executor: slurm\nslurm: {cluster: local, jobs: 4, cpus: 1, minutes: 5}\n",
    "ray": "executor: ray\nray: {cpus: 1, address: ADDRESS}\n",
}


@contextmanager
def cluster():
    """Ray on this machine: two nodes with room for two runs each. Yields its address and a function that kills one."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 2})
    try:
        node = made.add_node(num_cpus=2)
        made.wait_for_nodes()
        yield made.address, lambda: made.remove_node(node, allow_graceful=False)
    finally:
        made.shutdown()


def table(bench) -> list[list[str]]:
    write_tables(bench.options.folder)
    with open(bench.options.folder / "tables" / "runs.csv", newline="") as file:
        return [row for row in csv.reader(file)]


def expected(bench) -> list[tuple[str, ...]]:
    return sorted((c.object, c.setting, str(c.seed), "done") for c in bench.cells)


# a job of submitit is a Python of its own: minutes
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", ["local", "ray", pytest.param("slurm", marks=pytest.mark.slow)])
def test_a_hundred_runs(name, bench_file, program, monkeypatch):
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    monkeypatch.setenv("FAKE_P2GS_SLEEP", "0.1")
    if name != "local":
        pytest.importorskip({"slurm": "submitit", "ray": "ray"}[name])
    killed = 0

    def carry_out(address="null", kill=None):
        nonlocal killed
        text = EXECUTORS[name].replace("ADDRESS", f"'{address}'")
        bench = read_bench([bench_file(f"settings: {{full: {{}}}}\nseeds: {list(range(50))}\n{text}")])
        over = threading.Event()

        def half_way():
            nonlocal killed
            while sum(map(is_done, bench.cells)) < 50:
                if over.wait(0.05):
                    return
            kill()
            killed += 1

        thread = threading.Thread(target=half_way if kill else over.set)
        thread.start()
        with redirect_stdout(io.StringIO()):
            counts = run_bench(bench, program=program)
        over.set()
        thread.join()
        return bench, counts

    if name == "ray":
        with cluster() as (address, kill):
            bench, counts = carry_out(address, kill)
        assert killed == 1
    else:
        bench, counts = carry_out()
    assert counts == {"done": 100}
    assert all(is_done(c) and read_record(c.run)["status"] == "done" for c in bench.cells)
    head, *rows = table(bench)
    assert sorted((r[0], r[2], r[3], r[4]) for r in rows) == expected(bench)
    scored = Counter(line.split()[1] for line in program.calls("test"))
    assert len(scored) == 100 and sum(scored.values()) == 100, "none counted twice"
    again = len(program.calls("fit")) - 100
    assert 0 <= again <= 2 and (name == "ray" or again == 0), "only what ran on that node is begun again"
