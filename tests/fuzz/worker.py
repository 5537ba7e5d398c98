"""Fuzz in a process of its own, with little memory: ``python tests/fuzz/worker.py FOLDER --seed 0 --count 200 [--only
N]``.

Prints one JSON line a fault and one with the totals. A mutant is a function of seed and number alone: ``--only N`` does
that one again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import resource
import shutil
import signal
import sys
import time
import traceback
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "export")]

MEMORY = 2 << 30  # bytes beyond what the program has after its imports
CPU_SECONDS, WALL_SECONDS = 20, 120  # a mutant may take: work without end, and waiting without end


class Hangs(Exception):
    pass


def _alarm(signum, frame):
    raise Hangs(f"no end after {CPU_SECONDS} s of work or {WALL_SECONDS} s of waiting")


def limit_memory() -> None:
    """At most ``MEMORY`` more of private writable memory; address space that is only reserved does not count."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    now = int(fields["VmData"].split()[0]) << 10
    resource.setrlimit(resource.RLIMIT_DATA, (now + MEMORY, now + MEMORY))


def one(name: str, sound: Path, work: Path, rng: random.Random) -> tuple[str, str | None]:
    """(what was damaged, the fault or None)."""
    from mutants import mutate_file
    from targets import TARGETS

    from p2gs.types import UserError

    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(sound, work)
    path = work / rng.choice(sorted(str(p.relative_to(sound)) for p in sound.rglob("*") if p.is_file()))
    done = f"{path.relative_to(work)}: {mutate_file(path, rng)}"
    said = io.StringIO()
    signal.setitimer(signal.ITIMER_VIRTUAL, CPU_SECONDS)
    signal.setitimer(signal.ITIMER_REAL, WALL_SECONDS)
    try:
        with contextlib.redirect_stderr(said):
            TARGETS[name].read(work)
    except UserError as err:
        return done, None if str(err).strip() and "Traceback" not in str(err) else f"no sentence: {str(err)[:300]}"
    except BaseException:
        return done, traceback.format_exc(limit=-4)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    return done, None


def main() -> None:
    ask = argparse.ArgumentParser()
    ask.add_argument("folder", type=Path)
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--count", type=int, default=200)
    ask.add_argument("--only", type=int)
    args = ask.parse_args()
    import torch
    from targets import TARGETS

    from p2gs.config.run import import_builtins

    torch.set_num_threads(1)
    import_builtins()
    signal.signal(signal.SIGVTALRM, _alarm)
    signal.signal(signal.SIGALRM, _alarm)
    for name, target in TARGETS.items():
        (args.folder / name).mkdir(parents=True)
        target.make(args.folder / name)
        if name != "checkpoint":
            target.read(args.folder / name)  # sound files are read
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    limit_memory()
    order = [name for name, target in TARGETS.items() for _ in range(target.share)]
    faults, began = 0, time.process_time()
    for number in range(args.count) if args.only is None else [args.only]:
        name = order[number % len(order)]
        done, fault = one(name, args.folder / name, args.folder / "work", random.Random(f"{args.seed}/{number}"))
        if fault is not None:
            faults += 1
            print(json.dumps({"number": number, "target": name, "damage": done, "fault": fault}), flush=True)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) >> 10
    print(
        json.dumps(
            {
                "mutants": args.count,
                "faults": faults,
                "grown_mib": grown,
                "seconds": round(time.process_time() - began, 1),
            }
        )
    )


if __name__ == "__main__":
    main()
