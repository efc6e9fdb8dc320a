"""What the pipe tools load before they do anything: their start is paid with every line of a script."""

from __future__ import annotations

import subprocess
import sys

import pytest

from sioms.tools.generate import TREE

HEAVY = {
    "argparse",
    "asyncio",
    "collections",
    "dataclasses",
    "enum",
    "functools",
    "msgpack",
    "numpy",
    "re",
    "socket",
    "typing",
}


@pytest.mark.parametrize("tool", ["devin", "devout", "sdev", "smarkers"])
def test_nothing_heavy_is_loaded(tool):
    script = f"import sys; sys.path.append({str(TREE)!r}); import sioms.tools.{tool}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-I", "-S", "-c", script], capture_output=True, text=True, check=True)
    assert f"sioms.tools.{tool}" in done.stdout.split()
    assert HEAVY.isdisjoint(done.stdout.split())
