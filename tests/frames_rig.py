"""Rig for tests of frames: what a transport does with bytes, and the table of the vendors' own."""

from __future__ import annotations

from pathlib import Path

from sioms.sdk.exchange import Exchange, LinkError

GOLDEN = [
    tuple(line.split("|"))
    for line in (Path(__file__).parent / "protocol" / "golden_frames.txt").read_text().splitlines()
    if not line.startswith("#")
]
"""Family, check and text of each frame."""


def feed(exchange: Exchange, data: bytes, step: int) -> object:
    """Do what a transport does: gather bytes until the reply is complete, cut it off, decode it."""
    got = b""
    for i in range(0, len(data), step):
        got += data[i : i + step]
        size = exchange.want(got)
        if size is not None and len(got) >= size:
            return exchange.decode(got[:size])
    raise LinkError("incomplete")
