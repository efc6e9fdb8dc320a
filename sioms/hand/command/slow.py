"""``sioms hand slow``: the configuration of a simulated hand's cell in slow motion, for a slow or busy machine."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sioms.arguments import positive

PACE = 0.25


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("config", type=Path, metavar="FILE", help="configuration of the cell, such as etc/hand.toml")
    parser.add_argument(
        "--pace", type=positive, default=PACE, metavar="P", help=f"simulated seconds per second (default {PACE:g})"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="output file (default: standard output)")


def run(args: argparse.Namespace) -> int:
    """Write the configuration."""
    from sioms.documents import read_bytes, toml_of, toml_text
    from sioms.hand.slow import slowed

    try:
        try:
            tables = toml_of(read_bytes(args.config))
        except ValueError as error:
            raise ValueError(f"read {args.config}: {error}") from None
        text = toml_text(slowed(tables, args.pace, args.config.resolve().parent))
        if args.output is None:
            sys.stdout.write(text)
        else:
            args.output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ValueError(f"slow cell: {error.filename}: {error.strerror}") from None
    return 0
