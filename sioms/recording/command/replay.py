"""``sioms replay``: serve a recording as read-only nodes."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from typing import Any

from sioms.arguments import positive
from sioms.children import ends_with_us
from sioms.ending import on_end
from sioms.recording.live.replay import Replay
from sioms.recording.reader import Recording


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    one = subparsers.add_parser(
        "replay",
        help="serve a recording as read-only nodes",
        description="Serve the nodes of a recording, to be read by every tool, on a socket of its own; they begin to "
        "change when the first of them is opened. With a command: run it with this socket, and end when it ends.",
    )
    one.add_argument("file", metavar="FILE")
    one.add_argument("words", metavar="COMMAND", nargs="*", help="command to run, after --")
    one.add_argument("-r", "--rate", type=positive, default=1.0, metavar="RATE", help="playback speed (default: 1)")
    one.add_argument("--loop", action="store_true", help="start again at the end")
    one.add_argument("--socket", metavar="PATH", help="socket to serve (default: a new one, which is printed)")


def run(args: argparse.Namespace) -> int:
    """Serve; return the exit status, of the command if there is one."""
    ended = False

    def end() -> None:
        nonlocal ended
        ended = True

    with tempfile.TemporaryDirectory(prefix="sioms-replay-") as folder, Recording(args.file) as recording:
        replay = Replay(recording, args.socket or os.path.join(folder, "siomsd.sock"), args.rate)
        on_end(end)
        child: subprocess.Popen[bytes] | None = None
        if args.words:
            environment = {**os.environ, "SIOMS_SOCKET": replay.path}
            child = subprocess.Popen(args.words, env=environment, preexec_fn=ends_with_us(gently=True))
        else:
            print(f"SIOMS_SOCKET={replay.path}", flush=True)

        def until() -> bool:
            return ended or (child is not None and child.poll() is not None)

        try:
            replay.run(until)
            while args.loop and not until():
                replay.run(until, wait=False)
        finally:
            replay.close()
            for text in recording.damage:
                print(f"sioms replay: {text}", file=sys.stderr)
            status = child.wait() if child is not None else 0
        return status if child is not None else int(bool(recording.damage))
