"""The command line: the way from words to a command of ``p2gs.commands``, with readable errors."""

from __future__ import annotations

import argparse
import difflib
import os
import sys
from typing import Any

from p2gs.commands.parser import Parser, UsageError, parser
from p2gs.machine import is_of_the_machine, machine_says
from p2gs.stopping import EXIT_CODE, Terminated

COMMANDS = ("fit", "test", "predict", "export", "view", "data", "bench", "table", "version")
TIMED = ("kernels", "scaling", "peers")  # benches that time something instead of running a matrix


def run(words: list[str], prog: str = "p2gs") -> int:
    """Parse and carry out one command; returns the exit code. Mistakes come as one line ``error: ...`` on stderr."""
    top = parser(prog)
    streams: tuple[Any, ...] = (sys.stdout, sys.stderr)
    for stream in streams:  # names of files may hold bytes that are no text
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        # these have options of their own; a positional of bench would take the values of --key value
        if words[:1] == ["bench"] and words[1:2] and words[1] in TIMED:
            args, rest = argparse.Namespace(command="bench", action=words[1]), words[2:]
        else:
            args, rest = top.parse_known_args(words)
        if args.command is None:
            top.print_help()
            return 0
        if rest and args.command not in ("fit", "bench"):
            command = f"{prog} {args.command}"
            raise UsageError(
                f"'{rest[0]}' is no option of {command}{_similar(rest[0], top, args)} (see {command} --help)"
            )
        return _carry_out(args, rest)
    except UsageError as err:
        return _fail(str(err))
    except Terminated:
        return _stopped(words, EXIT_CODE)
    except SystemExit as err:  # argparse after --help; Lightning turns an interrupt into this
        if isinstance(err.__context__, KeyboardInterrupt):
            return _stopped(words, 130)
        return err.code if isinstance(err.code, int) else int(err.code is not None)
    except KeyboardInterrupt:
        return _stopped(words, 130)
    except BrokenPipeError:  # the reader of our output has gone (| head)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (OSError, MemoryError) as err:
        if not is_of_the_machine(err):
            raise
        print(f"error: {machine_says(err)}{_go_on(words)}", file=sys.stderr)
        return 1


def _carry_out(args: argparse.Namespace, rest: list[str]) -> int:
    if args.command == "version":
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"p2gs {version('p2gs')}")
        except PackageNotFoundError:
            print("p2gs (not installed: run from source)")
        return 0
    from p2gs.types import UserError  # from here on torch is loaded

    try:
        if args.command == "fit":
            from p2gs.commands.fit import fit

            return fit(args, rest)
        if args.command == "data":
            from p2gs.commands.data import data

            return data(args)
        if args.command in ("bench", "table"):
            from p2gs.commands import bench

            return bench.bench(args, rest) if args.command == "bench" else bench.table(args)
        from p2gs.commands import runs

        return getattr(runs, args.command)(args)
    except UserError as err:
        return _fail(str(err))


def _fail(message: str) -> int:
    print("error: " + " ".join(message.split()), file=sys.stderr)
    return 2


def _stopped(words: list[str], code: int) -> int:
    print(f"\nstopped{_go_on(words)}", file=sys.stderr)
    return code


def _go_on(words: list[str]) -> str:
    return "; give the same command again to go on where it stopped" if words[:1] in (["fit"], ["bench"]) else ""


def _similar(word: str, top: Parser, args: argparse.Namespace) -> str:
    commands = next(a for a in top._actions if isinstance(a, argparse._SubParsersAction))
    known = [option for action in commands.choices[args.command]._actions for option in action.option_strings]
    close = difflib.get_close_matches(word.split("=")[0], known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""
