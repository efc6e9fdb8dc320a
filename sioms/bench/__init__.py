"""``sioms bench``: measures the promises on this machine, against baselines measured in the same run.

Each sub-bench starts its own daemon on its own socket with a generated configuration of simulated
devices, and uses the public client library, the pipe tools and real processes. It reports percentiles,
counts and processor shares, never fails because a bar is missed, and leaves nothing behind.

    sioms bench --quick                  all sub-benches, some seconds each
    sioms bench read write --json out.json
    sioms bench open --soak 1000000
    sioms bench fuzz --target message --frames 20000000
"""

from __future__ import annotations

from .command import add_parser, run

__all__ = ["add_parser", "run"]
