"""``siomsd``: the daemon's command line."""

from __future__ import annotations

import re
import sys
from contextlib import suppress

from sioms.safe_path import leave_working_directory

from .fork_server_process import start_fork_server

MOST_LOOKED_AT, MOST_READ = 50, 1 << 16
"""Files, and bytes of each, in which a configuration is looked for."""


def main(argv: list[str] | None = None) -> int:
    """Run the daemon, or check a configuration; return the exit status."""
    leave_working_directory()
    fork_server = start_fork_server()  # it imports numpy and the motion core while we import; it ends when we do
    import argparse
    import signal

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # until the service listens to signals: the end, and no traceback

    parser = argparse.ArgumentParser(
        prog="siomsd",
        description="SIOMS device daemon: exposes the devices of a workcell as nodes of class axis, analog and binary.",
    )
    parser.usage = "siomsd --config FILE [--socket PATH] [--check] [--log-level LEVEL]"
    parser.add_argument("--config", metavar="FILE", help="configuration (TOML)")
    parser.add_argument("--socket", metavar="PATH", help="where to listen, instead of the configured or default path")
    parser.add_argument("--check", action="store_true", help="check the configuration and exit")
    parser.add_argument("--log-level", default="info", choices=("debug", "info", "warning", "error"))
    options, others = parser.parse_known_args(argv)
    if others and not others[0].startswith("-") and options.config is None:
        parser.error(f"{others[0]}: want --config {others[0]}")
    if others:
        parser.error(f"unrecognized arguments: {' '.join(others)}")
    if options.config is None:
        parser.error(f"no configuration was given; {_what_to_give()}")
    from .service import check, serve

    if options.check:
        return check(options.config, fork_server)
    return serve(options.config, options.socket, options.log_level, fork_server)


def _what_to_give() -> str:
    """Tell which configuration there is in this folder, or how to have one written."""
    from pathlib import Path

    from sioms.protocol.text import printable

    found = []
    for path in sorted(each for each in Path().glob("*.toml") if each.is_file())[:MOST_LOOKED_AT]:
        with suppress(OSError), path.open("rb") as file:
            if re.search(rb"^\s*\[(?:workcell\]|device\.)", file.read(MOST_READ), re.MULTILINE):
                found.append(printable(path.name, 80))
    if not found:
        return "want --config FILE; `sioms init` writes one to begin with"
    ways = " or ".join(f"--config {name}" for name in found[:3])
    return f"want {ways}, which {'is' if len(found) == 1 else 'are'} in this folder"


if __name__ == "__main__":
    sys.exit(main())
