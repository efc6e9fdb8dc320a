"""``sioms mount``: device nodes as files."""

from __future__ import annotations

import argparse
import ctypes
import errno
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from sioms.arguments import positive
from sioms.client.workcell import Workcell

LEASE_S = 0.5
THREADS = 64
"""Calls that are served at the same time; libfuse serves ten unless it is told otherwise."""
LIBRARY = (
    "libfuse is not installed; run: apt-get install fuse3 (which brings libfuse3-3 and fusermount3), or the like of "
    "your system"
)


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    one = subparsers.add_parser(
        "mount",
        help="mount device nodes as files, for cat, echo, dd and any program",
        description="Mount the nodes of the workcell as files in a folder, until interrupted. A file that is open for "
        "writing is held; closing it, or the end of its process however it ends, halts its axes. Refusals are errnos; "
        "their sentences are in DIR/.log. Writing to DIR/.stop is an emergency stop of the workcell.",
    )
    one.add_argument("folder", metavar="DIR", help="empty folder")
    one.add_argument(
        "--lease", type=positive, default=LEASE_S, metavar="SECONDS",
        help=f"halt axes when their process is stopped, or this one hangs, for SECONDS (default: {LEASE_S:g})",
    )  # fmt: skip
    one.add_argument("--allow-other", action="store_true", help="admit all users, each with their own rights (as root)")


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted or unmounted; return the exit status."""
    folder = os.path.abspath(args.folder)
    fuse = _fuse()
    if not os.path.exists("/dev/fuse"):
        raise OSError(errno.ENODEV, "no /dev/fuse here; run: modprobe fuse, or give the container that device")
    _free(folder)
    with Workcell(name="sioms mount"):  # who cannot connect hears of it now
        from .filesystem import Nodes

    mounted = False

    def ready() -> None:
        nonlocal mounted
        mounted = True
        print(f"{folder}: mounted", flush=True)

    options: dict[str, Any] = {"allow_other": True} if args.allow_other else {}
    if fuse.fuse_version_major >= 3:
        options["max_idle_threads"] = THREADS // 4
    if (fuse.fuse_version_major, fuse.fuse_version_minor) >= (3, 12):
        options["max_threads"] = THREADS
    for number in (signal.SIGTERM, signal.SIGHUP):  # libfuse's own end the mount in order
        signal.signal(number, signal.SIG_DFL)
    try:
        fuse.FUSE(
            Nodes(args.lease, ready), folder, foreground=True, direct_io=True, fsname="sioms", subtype="sioms",
            attr_timeout=0, entry_timeout=0, negative_timeout=0, **options,
        )  # fmt: skip
    except RuntimeError as error:  # also where a signal has ended it
        if mounted:
            return 0
        needs = "" if os.geteuid() == 0 else "; without root it needs fusermount3"
        text = f"mount {folder}: libfuse has refused (status {error}), its own words are above{needs}"
        raise OSError(errno.EIO, text) from None
    return 0


def _fuse() -> Any:
    try:
        import mfusepy
    except (OSError, AttributeError) as error:
        print(f"sioms mount: {error}", file=sys.stderr)
        raise OSError(errno.ELIBACC, LIBRARY) from None
    return mfusepy


def _free(folder: str) -> None:
    """See that a folder is there, is empty, and is no mount that somebody has left behind."""
    try:
        inside = os.listdir(folder)
    except OSError as error:
        if error.errno != errno.ENOTCONN:
            raise
        print(f"sioms mount: {folder}: taking away a mount whose process was killed", file=sys.stderr)
        unmount(folder)
        inside = os.listdir(folder)
    if inside:
        raise OSError(errno.ENOTEMPTY, f"mount {folder}: want an empty folder; it holds {sorted(inside)[0]}")


def unmount(folder: str | Path) -> None:
    """Take a mount away, also one in use or without a process."""
    detach = 2
    if ctypes.CDLL(None).umount2(os.fsencode(folder), detach):
        with suppress(OSError):
            subprocess.run(["fusermount3", "-u", "-z", str(folder)], check=False, capture_output=True)
