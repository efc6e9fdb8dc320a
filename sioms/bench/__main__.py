"""``python -m sioms.bench``: the same as ``sioms bench``."""

from __future__ import annotations

import argparse
import sys

from .command import add_arguments, run


def main() -> int:
    """Run the bench from the command line."""
    parser = argparse.ArgumentParser(prog="sioms bench", description="Measure the guarantees of SIOMS on this machine.")
    add_arguments(parser)
    return run(parser.parse_args())


if __name__ == "__main__":
    sys.exit(main())
