"""A mount of one's own, where this machine lets one mount."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Self

from sioms.bridges.mount.command import unmount
from sioms.children import Process


@functools.cache
def why_not() -> str:
    """Return why nothing can be mounted here; '' where something can."""
    if not os.access("/dev/fuse", os.R_OK | os.W_OK):
        return "no /dev/fuse, or no right to it"
    if not _may_mount():
        return "no right to mount, as in a container without CAP_SYS_ADMIN"
    if os.geteuid() != 0 and shutil.which("fusermount3") is None:
        return "no fusermount3"
    done = subprocess.run([sys.executable, "-c", "import mfusepy"], capture_output=True, text=True)
    return "" if not done.returncode else done.stderr.strip().splitlines()[-1]


def _may_mount() -> bool:
    """Tell whether any program may here, fusermount3 with root's rights too: CAP_SYS_ADMIN is in the bounding set."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return bool(int(re.findall(r"CapBnd:\s*(\w+)", status)[0], 16) >> 21 & 1)


class Mount:
    """``sioms mount`` on a folder of its own. Use it in a ``with`` block.

    Args:
        daemon_socket: of the daemon.
        words: further words of the command line.

    Attributes:
        folder: where the nodes are.
        process: that serves them.
    """

    def __init__(self, daemon_socket: str, *words: str) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="sioms-mount-"))
        self.folder.chmod(0o755)
        before = os.environ.get("SIOMS_CELL")
        os.environ["SIOMS_CELL"] = daemon_socket
        try:
            self.process = Process(["sioms.tools.front", "mount", str(self.folder), *words], "mounted")
        finally:
            os.environ.pop("SIOMS_CELL")
            if before is not None:
                os.environ["SIOMS_CELL"] = before

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.end()
        unmount(self.folder)
        with contextlib.suppress(OSError):
            self.folder.rmdir()
