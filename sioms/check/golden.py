"""The driver's golden frames, checked by the kit in a process of its own: tools know no driver."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .rigs import Rig
from .trial import Result, Verdict

NAME = "golden"
TEXT = "its golden frames: made, and read whole, byte by byte, with trailing bytes and with each bit flipped"
EXPECTED = "each request byte for byte, each reply with its value, and no damaged reply with another"


class ProbeFailed(Exception):
    """The driver cannot be looked at; the text says why."""


def probe(name: str, folder: Path | None = None, table: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return what the kit says of a driver: its rig and its golden frames.

    Args:
        name: registered name, or path of a file.
        folder: where relative paths start.
        table: of the device, for drivers whose frames depend on it.

    Raises:
        ProbeFailed: there is no such driver, or its file does not load.
    """
    command = [sys.executable, "-P", "-m", "sioms.sdk.probe", name, str(folder or Path.cwd())]
    command += [json.dumps(table)] if table is not None else []
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if done.returncode:
        raise ProbeFailed((done.stderr.strip().splitlines() or ["it said nothing"])[-1])
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def check_frames(rig: Rig, folder: Path | None) -> Result:
    """Check the golden frames of a driver or a register map."""
    began = time.monotonic()
    try:
        frames = probe(rig.driver, folder, rig.table)["golden"]
    except ProbeFailed as error:
        return Result(NAME, TEXT, Verdict.FAILED, str(error), "a driver that loads")
    took_s = round(time.monotonic() - began, 3)
    if not frames:
        why = "it names none: let its class method golden() return some from the vendor's manual"
        why = why if rig.line else "the driver has no line"
        return Result(NAME, TEXT, Verdict.NOT_APPLICABLE, why, took_s=took_s)
    wrong = [frame for frame in frames if frame["wrong"]]
    if wrong:
        seen = "; ".join(f"{frame['what']}: {frame['wrong']}" for frame in wrong[:3])
        traffic = [
            line for frame in wrong for line in (f"> {frame['request']}", f"< {frame['reply']}") if len(line) > 2
        ]
        return Result(NAME, TEXT, Verdict.FAILED, seen, EXPECTED, traffic, took_s)
    flips = sum(frame["flips"] for frame in frames)
    missed = sum(frame["missed"] for frame in frames)
    if missed and rig.checked and rig.line == "serial":
        seen = f"{missed} of {flips} replies with one flipped bit decode to another value"
        traffic = [f"< {frame['reply']}" for frame in frames if frame["missed"]]
        return Result(NAME, TEXT, Verdict.FAILED, seen, EXPECTED, traffic, took_s)
    seen = f"{len(frames)} frames" + (f"; {flips - missed} of {flips} flipped bits noticed" if flips else "")
    return Result(NAME, TEXT, Verdict.PASSED, seen, took_s=took_s)
