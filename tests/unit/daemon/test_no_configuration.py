"""``siomsd`` without ``--config``: it tells which configuration is in the folder, or how to have one written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sioms.tools.front import main as front


def said_in(folder: Path, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-P", "-m", "sioms.daemon.main", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2 and not done.stdout
    return done.stderr


def test_it_tells_the_file_that_init_wrote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "`sioms init` writes one" in said_in(tmp_path)
    monkeypatch.chdir(tmp_path)
    front(["init", "cell.toml", "--name", "x"])
    assert "want --config cell.toml, which is in this folder" in said_in(tmp_path)
    assert "cell.toml: want --config cell.toml" in said_in(tmp_path, "cell.toml")
    assert "unrecognized arguments: -c cell.toml" in said_in(tmp_path, "-c", "cell.toml")


def test_it_tells_configurations_alone(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text("[project]\nname = 'x'\n# [device.a]\n")
    (tmp_path / "odd\x1b[2J.toml").write_text("\n[device.a]\n")
    (tmp_path / "b.toml").write_text("[workcell]\n")
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "folder.toml").mkdir()
    text = said_in(tmp_path)
    assert r"want --config b.toml or --config odd\x1b[2J.toml, which are in this folder" in text
    assert "pyproject" not in text and "\x1b" not in text
