"""The command line of the bench."""

from __future__ import annotations

import argparse
import os

import pytest

from sioms.bench import command, figures


def test_what_a_bench_starts_keeps_its_bytecode(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setitem(command.BENCHES, "fake", ("figures", "nothing"))
    monkeypatch.setattr(
        figures, "bench_fake", lambda *_: seen.append("PYTHONDONTWRITEBYTECODE" in os.environ), raising=False
    )
    monkeypatch.setattr(command.signal, "signal", lambda *_: None)
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    assert command.run(parser.parse_args(["fake"])) == 0
    assert seen == [False]
