"""Run ``sioms driver check`` as its users do."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


def run(*words: str) -> tuple[int, list[dict[str, Any]], str]:
    """Run the check as its users do; return its status, its reports and what it said."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "out.json"
        command = [sys.executable, "-m", "sioms.tools.front", "driver", "check", *words, "--json", str(out)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=900)
        reports = json.loads(out.read_text()) if out.exists() else []
        return done.returncode, reports, done.stdout + done.stderr
