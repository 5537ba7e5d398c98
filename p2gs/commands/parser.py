"""The parser of the command line, a function for each command. Standard library only."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

FIT_HELP = """\
Any option of the config can follow as --key.of.it VALUE; null switches a loss or callback off:

  --data.root DIR  --data.format artgs|dta|paris|synthetic  --phases.articulation.losses.contact null
  --phases.articulation.losses.part.weight 0.3  --callbacks.previews.every 500

--print_config shows every option with its value. A run that was interrupted goes on when the same command is given
again.
"""

BENCH_HELP = """\
Options of the runs follow as --key.of.it VALUE and go to every fit: --phases.single_state.steps 500. A bench that was
stopped goes on when the same command is given again; runs that have their scores are not run again. p2gs table makes
the tables.
"""


SEVERAL: dict[str, Any] = {"nargs": "+", "action": "extend", "default": []}
STRICT: dict[str, Any] = {
    "action": "store_true",
    "help": "refuse files that lead out of the scene's folder (else they are only named)",
}


class UsageError(Exception):
    """A command line that cannot be understood, in one sentence."""


class Parser(argparse.ArgumentParser):
    """argparse whose errors are one sentence instead of the usage text."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs)

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def parser(prog: str = "p2gs") -> Parser:
    """The parser of all commands."""
    top = Parser(
        prog=prog, description="Photographs of an object in two joint states to an articulated digital twin (Part2GS)."
    )
    commands = top.add_subparsers(dest="command", metavar="COMMAND")
    for command in (_fit, _test, _predict, _export, _view, _data, _bench, _table):
        command(commands)
    _add(commands, "version", "print the version")
    return top


def _add(commands, name: str, text: str, **kwargs) -> Parser:
    return commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".", **kwargs)


def _fit(commands) -> None:
    fit = _add(commands, "fit", "take a scene from images to the finished twin", epilog=FIT_HELP)
    fit.add_argument("-c", "--config", **SEVERAL, metavar="FILE", help="YAML files, later ones laid on earlier ones")
    fit.add_argument("--only", metavar="PHASE", help="run this phase only (its predecessors must be there)")
    told = "use results of stages as they are, though options, code or photographs that made them have changed"
    fit.add_argument("--keep_stale", "--keep-stale", action="store_true", help=told)
    fit.add_argument("--print_config", action="store_true", help="print the merged config with all defaults and stop")
    fit.add_argument("--plugins", **SEVERAL, metavar="MODULE", help="modules with losses, callbacks, ... of your own")
    fit.add_argument("--run", metavar="DIR", help="result folder (default runs/<scene>)")
    parts = fit.add_mutually_exclusive_group()
    parts.add_argument("--num_parts", metavar="N", help="number of parts including the static base, or auto (default)")
    parts.add_argument("--movable", type=int, metavar="N", help="number of moving parts (num_parts - 1)")
    fit.add_argument("--seed", metavar="N", help="default 0")
    fit.add_argument("--device", metavar="auto|cpu|cuda", help="default auto")
    fit.add_argument("--threads", metavar="N", help="CPU threads (default all cores)")
    fit.add_argument("--strict_paths", "--strict-paths", **STRICT)


def _test(commands) -> None:
    test = _add(commands, "test", "score a run against the scene's ground truth and write metrics.json")
    test.add_argument("run", metavar="RUN", help="result folder of a fit")
    test.add_argument("--root", metavar="DIR", help="the scene's folder, where it has moved since the fit")
    test.add_argument("--truth", metavar="DIR", help="a capture's true cameras, joints and meshes: score in metres")
    test.add_argument(
        "--match",
        choices=("joints", "mesh"),
        default="joints",
        help="which parts belong together: by joint or by mesh (not with --truth)",
    )


def _predict(commands) -> None:
    predict = _add(commands, "predict", "render a run's twin at any state between start (0) and end (1)")
    predict.add_argument("run", metavar="RUN", help="result folder of a fit")
    times = [0.0, 0.25, 0.5, 0.75, 1.0]
    predict.add_argument(
        "--times", type=float, nargs="+", default=times, metavar="T", help="states (default 0 .25 .5 .75 1)"
    )
    predict.add_argument("--out", metavar="DIR", help="folder for the pictures (default RUN/media/states)")
    predict.add_argument("--size", type=int, metavar="PX", help="longer side of the pictures")
    predict.add_argument("--video", action="store_true", help="also a video of the motion")


def _export(commands) -> None:
    export = _add(commands, "export", "write a run's twin in other formats")
    export.add_argument("run", metavar="RUN", help="result folder of a fit")
    export.add_argument(
        "--format", nargs="+", metavar="NAME", help="urdf, mjcf, glb, usd, splats, spz, ply, obj, all (default)"
    )
    told = "all that one simulator takes, named and textured, into --out: simready, isaac, mujoco, sapien, partnet"
    export.add_argument("--profile", metavar="NAME", help=told)
    export.add_argument(
        "--meta", metavar="FILE", help="YAML or JSON with author, asset_license, category, qcode, ... for --profile"
    )
    export.add_argument("--out", metavar="DIR", help="folder to write to (default RUN)")
    stand = export.add_mutually_exclusive_group()
    told = "the base stands fast in the world (URDF: on a link 'world')"
    stand.add_argument("--fixed_base", "--fixed-base", dest="fixed", action="store_true", default=None, help=told)
    stand.add_argument(
        "--floating", dest="fixed", action="store_false", default=None, help="the base may be pushed and fall over"
    )
    size = export.add_mutually_exclusive_group()
    size.add_argument("--scale", type=float, metavar="M", help="metres per unit of the input (default 1)")
    size.add_argument(
        "--height", type=float, metavar="M", help="the object's height at the start in metres, instead of --scale"
    )
    export.add_argument(
        "--material", default="chipboard", help="density: chipboard (default), wood, plastic, metal, glass, ceramic"
    )
    told = (
        "call parts by what they are (drawer, door, lid, ...), needs --out; those that geometry gets wrong as PART=NAME"
    )
    export.add_argument("--name", nargs="*", metavar="PART=NAME", help=told)
    export.add_argument(
        "--up", choices=("x", "y", "z"), help="axis that points up in the file (default: the format's own)"
    )
    export.add_argument(
        "--extend_range", "--extend-range", action="store_true", help="joint limits until parts touch, not as observed"
    )
    export.add_argument(
        "--texture", action="store_true", help="baked textures, for programs that show no vertex colours"
    )
    export.add_argument(
        "--splats", action="store_true", help="each part's Gaussians in USD too (OpenUSD 26.03 and later show them)"
    )
    export.add_argument(
        "--check", action="store_true", help="write nothing: run the files that are there in every engine installed"
    )
    export.add_argument(
        "--origin", choices=("keep", "center", "bottom"), default="keep", help="where the origin is put (default keep)"
    )


def _view(commands) -> None:
    view = _add(commands, "view", "look at a run's twin in the browser")
    view.add_argument("run", metavar="RUN", help="result folder of a fit")
    view.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (0.0.0.0: reachable from other machines)"
    )
    view.add_argument("--port", type=int, default=8080)


def _data(commands) -> None:
    data = _add(commands, "data", "check a scene folder or generate a scene")
    actions = data.add_subparsers(dest="action", metavar="ACTION", required=True)
    for action in (_check, _synth, _render, _capture, _board, _prepare):
        action(actions)


def _check(actions) -> None:
    check = _add(actions, "check", "name the problems of a scene folder")
    check.add_argument("root", metavar="DIR")
    check.add_argument("--format", metavar="NAME", help="layout (default: found by looking)")
    check.add_argument("--strict_paths", "--strict-paths", **STRICT)


def _synth(actions) -> None:
    synth = _add(actions, "synth", "generate and ray-trace a small scene")
    synth.add_argument("out", metavar="OUT", help="folder to write")
    synth.add_argument("--seed", type=int, default=0, metavar="S")
    synth.add_argument("--kind", metavar="NAME", help="kind of object")
    synth.add_argument("--size", type=int, metavar="PX", help="image size")
    synth.add_argument("--views", type=int, metavar="N", help="training views a state")
    synth.add_argument("--test_views", type=int, metavar="N", help="test views a state")
    synth.add_argument("--format", choices=("artgs", "dta", "paris"), default="artgs", help="layout (default artgs)")
    synth.add_argument("--no_depth", action="store_true", help="write no depth maps")


def _render(actions) -> None:
    about = "Render a URDF or MJCF asset in two states as a scene with ground truth; without --joints, list its joints."
    render = actions.add_parser("render", help="a URDF or MJCF in two states as a scene", description=about)
    render.add_argument("asset", metavar="ASSET", help="URDF or MJCF file")
    render.add_argument("out", metavar="OUT", nargs="?", help="folder to write")
    render.add_argument("--joints", metavar="NAME=START:END,...", help="degrees or lengths; other joints rest")
    render.add_argument("--format", choices=("artgs", "dta", "paris"), default="artgs", help="layout (default artgs)")
    render.add_argument("--size", type=int, default=400, metavar="PX", help="image size (default 400)")
    render.add_argument("--views", type=int, default=64, metavar="N", help="training views a state (default 64)")
    render.add_argument("--test_views", type=int, default=10, metavar="N", help="test views a state (default 10)")
    render.add_argument("--seed", type=int, default=0, metavar="S", help="of the cameras")
    render.add_argument("--samples", type=int, default=9, metavar="N", help="rays a pixel, a square (default 9)")
    render.add_argument("--cameras", metavar="SCENE", help="take the cameras of this scene")
    render.add_argument("--no_depth", action="store_true", help="write no depth maps")
    render.add_argument("--renderer", choices=("embree", "mitsuba"), default="embree", help="what makes the colours")


def _capture(actions) -> None:
    about = "Turn photographs (or videos) of two joint states into a scene."
    capture = actions.add_parser("capture", help="photographs of two states to a scene", description=about)
    capture.add_argument("start", metavar="SHUT", help="folder of photographs of the first state, or a video")
    capture.add_argument(
        "end", metavar="OPEN", help="the same of the second state; nothing but the parts may have moved"
    )
    capture.add_argument("--out", required=True, metavar="SCENE", help="folder to write")
    capture.add_argument(
        "--masks", metavar="DIR", help="masks of the object, white = object (default: alpha, else from 3D)"
    )
    means: dict[str, Any] = {"choices": ("object", "ignore"), "default": "object", "help": "ignore: nerfstudio's masks"}
    capture.add_argument("--mask_means", "--mask-means", **means)
    capture.add_argument(
        "--mask_model",
        "--mask-model",
        metavar="MODEL",
        help="draws the masks' edges: FILE.onnx, or sam2:CONFIG:CHECKPOINT (default: GrabCut)",
    )
    capture.add_argument(
        "--poses", metavar="PATH", help="a COLMAP model or transforms.json of both states: no structure from motion"
    )
    capture.add_argument(
        "--static", type=int, metavar="N", help="which of hypotheses.html is the room (default: the widest)"
    )
    size = capture.add_mutually_exclusive_group()
    size.add_argument(
        "--height", type=float, metavar="M", help="height of the object in metres, where there is no board"
    )
    size.add_argument(
        "--length",
        type=float,
        nargs=7,
        metavar=("M", "X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="metres between two places, likewise; click them in SCENE/capture.html",
    )
    capture.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="what the object is within, in both states; click it in SCENE/capture.html (default: what cameras look "
        "at)",
    )
    capture.add_argument(
        "--max_views", "--max-views", type=int, default=60, metavar="N", help="photographs a state (default 60)"
    )
    capture.add_argument(
        "--size", type=int, default=1600, metavar="PX", help="longer side of the scene's images (default 1600)"
    )
    capture.add_argument(
        "--careful", action="store_true", help="more features, every pair of photographs: several times slower"
    )


def _board(actions) -> None:
    board = actions.add_parser(
        "board", help="a marker sheet to print, for scale and up", description="A marker sheet to print."
    )
    board.add_argument("--out", default="board.pdf", metavar="FILE", help="PDF or PNG (default board.pdf)")


def _prepare(actions) -> None:
    about = "Check a downloaded benchmark against the object lists."
    ready = actions.add_parser("prepare", help="check a downloaded benchmark", description=about)
    ready.add_argument("root", metavar="DIR", help="the downloaded tree")
    ready.add_argument(
        "--objects", nargs="+", default=["all"], metavar="NAME", help="benchmarks or object ids (default all)"
    )


def _bench(commands) -> None:
    bench = _add(
        commands,
        "bench",
        "run objects x settings x seeds; bench kernels, scaling, peers: rasterizers, growth, another program",
        epilog=BENCH_HELP,
    )
    bench.set_defaults(action="runs")
    bench.add_argument(
        "-c", "--config", **SEVERAL, metavar="FILE", help="YAML files of benches, such as bench/paris.yaml"
    )
    bench.add_argument("--root", metavar="DIR", help="the tree that holds the objects")
    bench.add_argument("--out", metavar="DIR", help="result folder (default runs/bench/<name>)")
    bench.add_argument("--preset", metavar="NAME", help="instead of the bench's own preset, such as paper_literal")
    bench.add_argument(
        "--num_parts", metavar="N", help="of settings that say nothing of it: a number, auto, gt, gt+1, ..."
    )
    bench.add_argument(
        "--objects",
        nargs="+",
        metavar="NAME",
        help="these instead: benchmarks, object ids or scene folders below --root",
    )
    bench.add_argument("--settings", nargs="+", metavar="NAME", help="only these settings")
    bench.add_argument("--seeds", nargs="+", metavar="N", help="default 0 1 2")
    bench.add_argument("--executor", metavar="local|slurm|ray", help="where the runs are carried out (default local)")
    bench.add_argument("--processes", metavar="N", help="runs at once, for local (default 1)")
    bench.add_argument("--dry_run", action="store_true", help="print the runs and their commands and stop")
    bench.add_argument("--skip_failed", action="store_true", help="do not try again what failed before")


def _table(commands) -> None:
    table = _add(commands, "table", "put a bench's results beside the paper's: Markdown, LaTeX, CSV, plots")
    table.add_argument("bench", metavar="BENCH_DIR", help="result folder of a bench")
    table.add_argument(
        "--tables", nargs="+", metavar="NAME", help="tables of the paper to fill (default: those that the bench names)"
    )
    table.add_argument("--out", metavar="DIR", help="folder for the tables (default BENCH_DIR/tables)")
