"""SIGTERM, as schedulers send it some seconds before SIGKILL, and Ctrl-C: the step is finished, the state is saved, the
exit code says that the run is not done."""

from __future__ import annotations

import signal
import threading
from contextlib import contextmanager
from typing import Iterator

EXIT_CODE = 128 + signal.SIGTERM  # 143, what a shell reports of a process that SIGTERM ended


class Terminated(SystemExit):
    """The process was asked to end by SIGTERM."""

    def __init__(self):
        super().__init__(EXIT_CODE)


class _State:
    training = False
    asked = False
    interrupted = False


@contextmanager
def heeding_sigterm() -> Iterator[None]:
    """Inside, SIGTERM raises Terminated where the main thread is; within ``at_step_ends`` when the step has been
    done."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return
    before = signal.signal(signal.SIGTERM, _heed)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def at_step_ends() -> Iterator[None]:
    """Around a Trainer's fit: Lightning ends it after the step in which SIGTERM came (its handler calls ours), when
    parameters and optimiser agree and the checkpoint callback can save them; that leaves here as Terminated.

    A first Ctrl-C does the same and leaves as KeyboardInterrupt; a second one interrupts at once. Raised amid a step,
    it can leave a lock or a queue of another library half taken: TensorBoard's writer then never closes.
    """
    from lightning.pytorch.utilities.exceptions import SIGTERMException

    _State.training, _State.asked, _State.interrupted = True, False, False
    before = _listen()
    try:
        yield
    except SIGTERMException as err:
        raise (KeyboardInterrupt if _State.interrupted else Terminated) from err
    finally:
        _State.training = False
        if before is not None:
            signal.signal(signal.SIGINT, before)
    if _State.asked:  # it came in the last step, or before the first
        raise KeyboardInterrupt if _State.interrupted else Terminated


def _listen():
    """Take Ctrl-C where Python would raise KeyboardInterrupt and SIGTERM is heeded; the handler before, else None."""
    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is _heed
    if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        return signal.signal(signal.SIGINT, _interrupt)
    return None


def _interrupt(signum, frame) -> None:
    if _State.interrupted:
        raise KeyboardInterrupt
    _State.interrupted = True
    signal.raise_signal(signal.SIGTERM)  # Lightning's handler, then ours


def leave_if_asked() -> None:
    """At the start of training: SIGTERM may have come before Lightning listened."""
    from lightning.pytorch.utilities.exceptions import SIGTERMException

    if _State.asked:
        raise SIGTERMException


def _heed(signum, frame) -> None:
    if _State.training:
        _State.asked = True
    else:
        raise Terminated
