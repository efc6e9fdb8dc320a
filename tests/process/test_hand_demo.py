"""``sioms hand demo`` from its first word to its last: a daemon, its drivers, and the death of one of them."""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path

import pytest

from sioms.hand.command import add_parser, demo, run


@pytest.mark.timeout(900)
def test_the_demonstration_ends_at_rest_as_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Object 5 is a disk: what two touches tell, so that it is not felt round, which takes a minute."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(demo, "HELD_S", 0.5)
    socket = os.environ.get("SIOMS_SOCKET")
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers(dest="command"))
    words = ["hand", "demo", "--object", "5", "--quiet", "--no-animation", "-o", str(tmp_path)]
    assert run(parser.parse_args(words)) == 0
    out = capsys.readouterr().out
    assert "number 5, a disk" in out and "touch2.shape: it cannot be read" in out
    worst, rest = re.search(r"at most ([\d.]+) deg", out), re.search(r"at rest (\d+) ms", out)
    assert worst is not None and float(worst[1]) < 1.5
    assert rest is not None and float(rest[1]) < 250.0
    assert (tmp_path / "hand.png").stat().st_size > 20_000 and not (tmp_path / "hand.gif").exists()
    assert os.environ.get("SIOMS_SOCKET") == socket
