"""``sioms driver trace`` and ``replay``: a line is recorded, and its driver speaks with the record."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

AUTHORS = Path(__file__).parent / "authors"


def sioms(*words: object) -> tuple[int, str]:
    command = [sys.executable, "-m", "sioms.tools.front", "driver", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    return done.returncode, done.stdout + done.stderr


def test_a_recorded_line_is_replayed_and_a_changed_one_is_not(start: Callable[..., Any], short_folder: Path) -> None:
    device = start([sys.executable, AUTHORS / "scale_device.py", "--link", short_folder / "port"])
    device.wait_line("^ready ")
    config, trace = short_folder / "cell.toml", short_folder / "scale.trace"
    table = f'driver = "{AUTHORS / "scale.py"}"\nline = {{ serial = "{short_folder / "port"}", baud = 9600 }}\n'
    config.write_text(f'[workcell]\nname = "t"\n[device.scale]\n{table}')
    status, said = sioms("trace", config, "scale", "-o", trace, "--seconds", "1")
    assert status == 0, said
    lines = trace.read_text().splitlines()
    assert sum('"d":">","b":"570d"' in line for line in lines) > 5
    assert sum('"d":"<"' in line for line in lines) > 5

    status, said = sioms("replay", trace)
    assert status == 0 and "link good" in said, said

    other = short_folder / "other.trace"
    other.write_text(trace.read_text().replace('"b":"570d"', '"b":"580d"'))
    status, said = sioms("replay", other)
    assert status == 1 and "the trace has 58 0d, the driver asks 57 0d; they differ from byte 0 on" in said, said


def test_no_trace_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("nothing\n")
    status, said = sioms("replay", tmp_path / "x")
    assert status == 2 and "is this a trace" in said
