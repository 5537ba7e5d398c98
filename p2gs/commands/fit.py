"""``p2gs fit``: config files and overrides to a finished twin."""

from __future__ import annotations

import argparse

from p2gs.config.files import overrides_layer, parse_overrides, read_config, to_yaml
from p2gs.config.run import RunConfig, config_of
from p2gs.registry import suggest
from p2gs.types import UserError

FLAGS = ("run", "num_parts", "seed", "device", "threads")


def config_from(args: argparse.Namespace, words: list[str]) -> RunConfig:
    """The config of a parsed command line; ``words`` are the overrides. Raises UserError."""
    layers = [layer for name in args.config for layer in read_config(name, strict=args.strict_paths)]
    overrides = [(name, getattr(args, name)) for name in FLAGS if getattr(args, name) is not None]
    if args.strict_paths:
        overrides.append(("strict_paths", "true"))
    if args.movable is not None:
        if args.movable < 1:
            raise UserError(f"--movable: expected at least 1 moving part, got {args.movable}")
        overrides.append(("num_parts", args.movable + 1))
    layers.append(overrides_layer(overrides + parse_overrides(words)))
    return config_of(layers, args.plugins)


def fit(args: argparse.Namespace, words: list[str]) -> int:
    cfg = config_from(args, words)
    if args.print_config:
        print(to_yaml(cfg.to_dict()), end="")
        return 0
    if not cfg.phases:
        raise UserError("there is nothing to fit: the config names no phase (try -c preset/cpu.yaml or -c demo.yaml)")
    if args.only is not None and args.only not in cfg.phases:
        raise UserError(f"--only: the config has no phase '{args.only}'{suggest(args.only, cfg.phases)}")
    _ = cfg.data  # a missing data.root is told before anything is written

    from p2gs.callbacks.base import silence_lightning
    from p2gs.runtime import pipeline
    from p2gs.stopping import heeding_sigterm

    silence_lightning()
    with heeding_sigterm():
        result = pipeline.run(cfg, only=args.only, keep_stale=args.keep_stale)
    print(f"result: {result}")
    return 0
