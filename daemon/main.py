"""``siomsd``: the daemon's command line."""

from __future__ import annotations

import sys

from sioms.safe_path import leave_working_directory

from .fork_server_process import start_fork_server


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
    parser.add_argument("--config", required=True, metavar="FILE", help="configuration (TOML)")
    parser.add_argument("--socket", metavar="PATH", help="where to listen, instead of the configured or default path")
    parser.add_argument("--check", action="store_true", help="check the configuration and exit")
    parser.add_argument("--log-level", default="info", choices=("debug", "info", "warning", "error"))
    options = parser.parse_args(argv)
    from .service import check, serve

    if options.check:
        return check(options.config, fork_server)
    return serve(options.config, options.socket, options.log_level, fork_server)


if __name__ == "__main__":
    sys.exit(main())
