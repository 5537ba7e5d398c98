"""Stands in for p2gs in the tests of the bench.

FAKE_P2GS_FAIL: text in the run's path that makes fit fail.  FAKE_P2GS_SLEEP: seconds of a fit.
"""

import fcntl
import json
import os
import sys
import time
from pathlib import Path

words = sys.argv[1:]
run = Path(words[words.index("--run") + 1] if words[0] == "fit" else words[1])
with open(os.environ["FAKE_P2GS_LOG"], "a") as log:
    log.write(" ".join(words) + "\n")
busy = open(run / "busy", "w")
try:
    fcntl.flock(busy, fcntl.LOCK_EX | fcntl.LOCK_NB)
except BlockingIOError:
    print("error: two processes in one run folder")
    sys.exit(2)
if words[0] == "fit":
    time.sleep(float(os.environ.get("FAKE_P2GS_SLEEP", "0")))
    fail = os.environ.get("FAKE_P2GS_FAIL")
    if fail and fail in str(run):
        print("a long story\nerror: the sky fell\nand some more")
        sys.exit(2)
    if fail == "KILL":
        os.kill(os.getpid(), 9)
    (run / "checkpoints").mkdir(exist_ok=True)
    (run / "logs").mkdir(exist_ok=True)
    for stage in ("single_state_0", "articulation"):
        if not (run / "checkpoints" / f"{stage}.pt").exists():
            (run / "checkpoints" / f"{stage}.pt").write_text(f"made in {run}")
    (run / "logs" / "stages.json").write_text(json.dumps({"fit": {"seconds": 60.0}}))
elif words[0] == "test" and os.environ.get("FAKE_P2GS_FAIL") != "SILENT":
    part = run / "metrics.part"
    part.write_text(json.dumps({"threads": os.environ.get("OMP_NUM_THREADS")}))
    part.replace(run / "metrics.json")
