"""A bench of 100 smoke runs through each executor: none lost, none counted twice, the same tables. ``make faults``.

Two scenes of ``p2gs data synth`` with 64 pixels; a quarter of an hour of one core for each executor.
"""

import csv
import json
import os
import threading
from collections import Counter
from pathlib import Path

import pytest
from whole_runs import REPO

from p2gs.bench.cell import PROGRAM, is_done, read_record
from p2gs.bench.plan import read_bench
from p2gs.bench.report import write_tables
from p2gs.bench.runner import run_bench
from p2gs.data.generated.generate import synthesize

pytestmark = [pytest.mark.slow, pytest.mark.timeout(0)]
RUNS = int(os.environ.get("P2GS_RUNS_OF_A_BENCH", "100"))
OF_TIME = ("minutes",)  # columns of runs.csv that are no result

FIT = """
include: [preset/smoke.yaml]
data: {depth: never}
phases:
  discovery:
    evidence_size: 48
    look_steps: 2
    reconsider: false
    seek: 0
    rounds: 1
    survey: []
    search: {surfels: 500, samples: 50, searches: 1, candidates: 1}
    coarse: {steps: 2, levels: [32]}
"""
BENCH = """
name: hundred
root: {root}
out: {out}
config: [{config}]
settings: {{smoke: {{}}}}
seeds: {seeds}
export: []
threads: 1
executor: {executor}
processes: 4
slurm: {{cluster: local, cpus: 1, jobs: 4, minutes: 60}}
ray: {{cpus: 1, address: {address}}}
"""
# Stands before p2gs and writes down what it was asked: two words in one folder at once would show.
LOGGED = """
import os, sys
with open(os.environ["P2GS_CALLS"], "a") as file:
    file.write(" ".join(sys.argv[1:]) + "\\n")
from p2gs.cli import main
sys.exit(main())
"""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    root = tmp_path_factory.mktemp("hundred")
    for seed in (3, 4):
        synthesize(root / "scenes" / f"obj{seed}", seed=seed, size=64, train_views=8, test_views=1, depth=False)
    (root / "fit.yaml").write_text(FIT)
    (root / "logged.py").write_text(LOGGED)
    return root


def rows(folder: Path) -> list[dict]:
    """runs.csv without times."""
    write_tables(folder)
    with open(folder / "tables" / "runs.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k not in OF_TIME} for row in csv.DictReader(file)]


def carry_out(scenes, name, monkeypatch, address="null", meanwhile=None):
    """The rows of runs.csv and how often each command was given for each run."""
    folder, calls = scenes / name, scenes / f"{name}.calls"
    monkeypatch.setenv("P2GS_CALLS", str(calls))
    monkeypatch.setenv("PYTHONPATH", str(REPO))
    monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
    path = scenes / f"{name}.yaml"
    values = {"root": scenes / "scenes", "out": folder, "config": scenes / "fit.yaml", "executor": name}
    path.write_text(BENCH.format(seeds=list(range(RUNS // 2)), address=address, **values))
    bench = read_bench([str(path)])
    assert len(bench.cells) == RUNS and len({c.run for c in bench.cells}) == RUNS
    thread = threading.Thread(target=meanwhile, args=(bench,)) if meanwhile else None
    if thread:
        thread.start()
    counts = run_bench(bench, program=(PROGRAM[0], str(scenes / "logged.py")))
    if thread:
        thread.join()
    assert counts == {"done": RUNS}, counts
    assert all(is_done(c) and read_record(c.run)["status"] == "done" for c in bench.cells)
    given = Counter(line.split()[0] for line in calls.read_text().splitlines())
    found = rows(folder)
    assert len(found) == RUNS and len({(r["object"], r["seed"]) for r in found}) == RUNS
    print(f"\n{name}: {RUNS} runs done, {dict(given)}")
    return found, given


@pytest.fixture(scope="module")
def reference(scenes):
    with pytest.MonkeyPatch.context() as patch:
        found, given = carry_out(scenes, "local", patch)
    assert given == {"fit": RUNS, "test": RUNS}
    return found


def test_in_processes_of_this_machine(reference):
    assert len({json.dumps(r, sort_keys=True) for r in reference}) == RUNS


def test_on_slurm(scenes, reference, monkeypatch):
    pytest.importorskip("submitit")
    found, given = carry_out(scenes, "slurm", monkeypatch)
    assert found == reference and given == {"fit": RUNS, "test": RUNS}


def test_on_ray_with_a_node_killed_half_way(scenes, reference, monkeypatch):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(REPO))
    monkeypatch.setenv("P2GS_CALLS", str(scenes / "ray.calls"))  # workers have the environment that their node began in
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2})
    try:
        node = cluster.add_node(num_cpus=2)
        cluster.wait_for_nodes()
        over = threading.Event()

        def kill(bench):
            while sum(map(is_done, bench.cells)) < RUNS // 2 and not over.wait(0.5):
                pass
            cluster.remove_node(node, allow_graceful=False)

        found, given = carry_out(scenes, "ray", monkeypatch, f"'{cluster.address}'", kill)
        over.set()
    finally:
        cluster.shutdown()
    assert found == reference
    assert given["test"] <= RUNS + 2 and RUNS <= given["fit"] <= RUNS + 2, given  # two ran on that node
