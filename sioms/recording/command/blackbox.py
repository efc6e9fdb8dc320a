"""``sioms blackbox``: explain what went wrong; keep the last minute of everything."""

from __future__ import annotations

import argparse
import errno
import fcntl
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from sioms.arguments import positive
from sioms.client.workcell import Workcell
from sioms.documents import json_text
from sioms.ending import on_end
from sioms.prompt import be_prompt
from sioms.recording.live.box import KEPT_S, Box, clear_up
from sioms.recording.live.recorder import Recorder
from sioms.recording.reader import Recording
from sioms.recording.story import happened, sentence, tell, utc
from sioms.whole_file import write_whole

from .record import size

KEEPER = "keeper.pid"
WRITTEN_S = 30.0
"""How long a box that was asked for may take [s]."""


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    one = subparsers.add_parser(
        "blackbox",
        help="explain what went wrong; keep the last minute of everything",
        description="Explain what happened in a black box or any other recording, in which order, and "
        "what began it. With --keep: keep the last minute of everything in memory, and write it to a file at each "
        "stop, fault and death, and on request.",
    )
    one.add_argument("file", metavar="FILE", nargs="?", help="box or recording (default: the newest in the folder)")
    one.add_argument("--keep", action="store_true", help="keep the last minute, until interrupted")
    one.add_argument("--write", action="store_true", help="write a box now and print its name")
    one.add_argument(
        "-d", "--folder", metavar="FOLDER", help="folder of boxes (default: $SIOMS_BLACKBOX, or the user's)"
    )
    one.add_argument("--memory", type=size, default=256_000_000, metavar="SIZE", help="memory limit (default: 256M)")
    one.add_argument("--seconds", type=positive, default=KEPT_S, metavar="SECONDS", help="time to keep (default: 60)")
    one.add_argument("--json", action="store_true", help="print JSON")
    one.add_argument("-a", "--all", action="store_true", help="print all events, not only those of the incident")


def run(args: argparse.Namespace) -> int:
    """Run the command; return the exit status."""
    folder = Path(args.folder or os.environ.get("SIOMS_BLACKBOX") or _usual())
    if args.keep:
        return _keep(folder, args.memory, args.seconds)
    if args.write:
        print(_write(folder))
        return 0
    path = args.file
    if path is None:
        boxes = sorted(folder.glob("*.mcap"))
        if not boxes:
            raise OSError(errno.ENOENT, f"no black box in {folder}; `sioms blackbox --keep` writes them")
        path = str(boxes[-1])
    return _tell(path, everything=args.all, as_json=args.json)


def _usual() -> str:
    state = (
        os.environ.get("STATE_DIRECTORY") or os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    )
    return os.path.join(state, "sioms", "blackbox")


def _tell(path: str, *, everything: bool, as_json: bool) -> int:
    with Recording(path) as recording:
        events = recording.events()
        story = tell(events)
        zero = story.first.stamp_ns if story.first is not None else (events[0].stamp_ns if events else 0)
        if as_json:
            first, offset = story.first, recording.offset_ns
            found = {
                "file": path, "about": recording.about, "cause": story.cause if first else None, "text": story.text,
                "begin_ns": first.stamp_ns + offset if first else None,
                "events": [happened(event, offset) for event in (events if everything else story.events)],
                "damage": recording.damage,
            }  # fmt: skip
            print(json_text(found))
            return 1 if recording.damage else 0
        print(f"{path}: workcell {recording.about.get('workcell', '?')} on {recording.about.get('host', '?')}")
        if story.first is not None:
            print(f"Cause: {story.cause}, at {utc(zero + recording.offset_ns)}: {story.text}.")
        else:
            print(f"Cause: none: {story.text}.")
        for event in events if everything else story.events:
            print(f"{(event.stamp_ns - zero) / 1e9:+11.6f} s  {sentence(event)}")
        for text in recording.damage:
            print(f"sioms blackbox: {text}", file=sys.stderr)
        return 1 if recording.damage else 0


def _keep(folder: Path, memory: int, seconds: float) -> int:
    folder.mkdir(parents=True, exist_ok=True)
    if not _lock(folder):
        text = f"keep boxes in {folder}: another keeper is at work there; name another folder, or end that one"
        raise OSError(errno.EBUSY, text)
    clear_up(folder)
    ended = False

    def end() -> None:
        nonlocal ended
        ended = True

    box = Box(folder, memory, seconds)
    on_end(end)
    signal.signal(signal.SIGUSR1, lambda *_: box.ask("request"))
    recorder: Recorder | None = None
    while recorder is None and not ended:
        try:
            recorder = Recorder(
                box, lambda: Workcell(name="sioms blackbox"), seen=box.seen,
                log=lambda text: print(f"sioms blackbox: {text}", file=sys.stderr),
            )  # fmt: skip
        except OSError as error:
            if error.errno not in (errno.ENOENT, errno.ECONNREFUSED, errno.EAGAIN, errno.EIO, errno.ETIMEDOUT):
                raise
            time.sleep(0.5)  # the daemon will come
    if recorder is None:
        return 0
    be_prompt()
    keeper = folder / KEEPER
    try:
        write_whole(keeper, f"{os.getpid()}\n")
        recorder.run(lambda: ended)
    finally:
        keeper.unlink(missing_ok=True)
        recorder.close()
    return 0


def _lock(folder: Path) -> bool:
    """Lock a folder for the life of this process; return whether no keeper has."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(fd)
        return False
    return True


def _write(folder: Path) -> str:
    """Have the keeper write a box; return its path."""
    before = set(folder.glob("*.mcap"))
    try:
        pid = int((folder / KEEPER).read_text())
        if _lock(folder):  # it was killed: that number may be another's by now
            raise ProcessLookupError
        os.kill(pid, signal.SIGUSR1)
    except (OSError, ValueError):
        text = f"no keeper is at work in {folder}; start one with `sioms blackbox --keep`"
        raise OSError(errno.ESRCH, text) from None
    deadline = time.monotonic() + WRITTEN_S
    while time.monotonic() < deadline:
        if new := sorted(set(folder.glob("*.mcap")) - before):
            return str(new[-1])
        time.sleep(0.05)
    raise OSError(errno.ETIMEDOUT, f"the keeper (process {pid}) has written no box to {folder} within {WRITTEN_S:g} s")
