"""The bench runs, its figures are sane, and what it finds beyond figures is good. No time is asserted."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sioms.bench.figures import Bar, Report, Summary
from sioms.bench.rights import ATTACKS

NAMES = ("p50", "p90", "p99", "p99.9", "max")


def bench(folder: Path, *words: str) -> list[dict[str, Any]]:
    """Run the bench as a user does and return its figures."""
    out = folder / "figures.json"
    command = [sys.executable, "-m", "sioms.bench", *words, "--quick", "--json", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr
    figures: list[dict[str, Any]] = json.loads(out.read_text())["figures"]
    assert figures
    return figures


def test_a_quick_bench_gives_ordered_percentiles_and_honest_bars(tmp_path: Path) -> None:
    words = ["read", "client", "fuzz", "--trials", "2", "--frames", "24000"]
    targets = ["--target", "daemon socket", "--target", "writer's handle"]
    figures = bench(tmp_path, *words, *targets)
    assert {f["bench"] for f in figures} == {"read", "client", "fuzz"}
    for figure in figures:
        if figure["percentiles"]:
            values = [figure["percentiles"][name] for name in NAMES]
            assert figure["count"] > 0 and values == sorted(values) and values[0] > 0
        for bar in figure["bars"]:
            assert bar["met"] == (bar["found"] >= bar["limit"] if bar["at_least"] else bar["found"] <= bar["limit"])
    found = {f["name"]: f for f in figures}
    assert found["read of 4 axes"]["baseline"] == "bare round trip" and found["read of 4 axes"]["ratio"] > 0
    assert found["client SIGKILL to its 4 axes halting"]["count"] == 2
    assert found["frames in all"]["value"] >= 1200
    for name in (
        "processes that died",
        "stray exceptions in the log",
        "motions without an acknowledged write",
    ):
        assert found[name]["value"] == 0, (name, found[name]["notes"])


def test_no_reading_is_older_than_what_was_acknowledged(tmp_path: Path) -> None:
    found = {f["name"]: f for f in bench(tmp_path, "stale", "--trials", "80")}
    assert found["interleavings in all"]["value"] == 80 and found["readings in all"]["value"] >= 80
    assert found["stale readings"]["value"] == 0, found["stale readings"]["notes"]


def test_two_writers_never_both_win(tmp_path: Path) -> None:
    figures = bench(tmp_path, "race")
    assert next(f for f in figures if f["name"] == "races without exactly one winner")["value"] == 0


def test_who_holds_a_key_or_none_gains_nothing_at_a_gateway(tmp_path: Path) -> None:
    """Each attack finds what it is given granted before, and a frame of a client that is let in counted."""
    figures = bench(tmp_path, "rights", "strangers", "--trials", "1", "--frames", "12000")
    attacks = [f for f in figures if f["name"].startswith("rights gained")]
    assert len(attacks) == len(ATTACKS) and all(f["value"] == 0 for f in attacks), attacks
    found = {f["name"]: f for f in figures}
    assert found["frames of strangers taken apart"]["value"] == 0
    assert found["the gateway serves others afterwards"]["value"] == 1


def test_an_unknown_name_is_refused_with_those_that_there_are() -> None:
    done = subprocess.run([sys.executable, "-m", "sioms.bench", "raed"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "raed" in done.stderr and "read" in done.stderr


def test_percentiles_of_a_hundred_numbers() -> None:
    summary = Summary.of(list(range(1000, 101_000, 1000)), "us")
    assert summary.count == 100
    assert [summary.values[name] for name in NAMES] == [51.0, 91.0, 100.0, 100.0, 100.0]


def test_no_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        Summary.of([], "us")


def test_a_ratio_is_that_of_medians_whatever_the_units(capsys: pytest.CaptureFixture[str]) -> None:
    report = Report()
    report.begin("some", "thing")
    base = report.samples("base", [2_000_000] * 3, "ms")
    ours = report.samples("ours", [1_000_000, 3_000_000, 9_000_000], "us", baseline=base, bars=[Bar("ratio", 1.0)])
    assert ours.ratio == pytest.approx(1.5)
    report.summary()
    assert "MISSED" in capsys.readouterr().out
