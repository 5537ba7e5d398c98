"""``python -m p2gs.runtime.side_worker RUN STAGE THREADS``: one training stage in the process that ``side_stage``
starts beside a run.

It reads RUN/config.yaml, leaves RUN/checkpoints/STAGE.pt, and stops, its state saved, when the pipe to its parent
closes.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

from p2gs.callbacks.base import silence_lightning
from p2gs.config.run import load_config
from p2gs.machine import is_of_the_machine, machine_says
from p2gs.runtime.pipeline import Pipeline
from p2gs.runtime.side_stage import MISTAKE
from p2gs.stopping import EXIT_CODE, Terminated, heeding_sigterm
from p2gs.types import UserError


def main(run_dir: str, stage: str, threads: str) -> int:
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    silence_lightning()
    try:
        cfg = load_config([str(Path(run_dir) / "config.yaml")])
        cfg.threads = int(threads)
        with heeding_sigterm():
            Pipeline(cfg).train_alone(stage)
    except UserError as err:
        print(MISTAKE + " ".join(str(err).split()), flush=True)
        return 2
    except OSError as err:
        if not is_of_the_machine(err):
            raise
        print(MISTAKE + machine_says(err), flush=True)
        return 1
    except Terminated:
        return EXIT_CODE
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the first into the second
        return 130
    return 0


def _stop_with_parent() -> None:
    """As a scheduler would: the step that is being done is finished, its state saved."""
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
