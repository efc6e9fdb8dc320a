"""Nothing is imported from the working directory, by whatever name a program of ours is started."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

TREE = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
PLANTED = ("msgpack", "msgspec", "numpy", "serial", "pymodbus", "zmq", "sioms_driver_mine")
CELL = '[device.io0]\ndriver = "sim-io"\noutputs = 8\n[device.force0]\ndriver = "sim-force"\n'


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """A folder of modules that leave a mark when they are imported."""
    mark = f"open({str(tmp_path / 'sprung')!r}, 'a').write(__name__ + ' ')\nraise ImportError('planted')\n"
    for name in PLANTED:
        (tmp_path / f"{name}.py").write_text(mark)
    (tmp_path / "cell.toml").write_text(CELL)
    return tmp_path


def plant_sioms(trap: Path) -> None:
    (trap / "sioms").mkdir()
    (trap / "sioms" / "__init__.py").write_text(
        f"open({str(trap / 'sprung')!r}, 'a').write('sioms ')\nraise ImportError('planted')\n"
    )


def run(trap: Path, *command: str | Path, path: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"SIOMS_SOCKET": str(trap / "no.sock")} | ({} if path is None else {"PYTHONPATH": path})
    done = subprocess.run(
        list(map(str, command)), cwd=trap, env=environment, capture_output=True, text=True, timeout=110, check=False
    )  # fmt: skip
    assert not (trap / "sprung").exists(), (command, (trap / "sprung").read_text(), done.stderr)
    assert "Traceback" not in done.stderr, done.stderr
    return done


@pytest.mark.parametrize(
    "command",
    [
        [BIN / "siomsd", "--check", "--config", "cell.toml"],
        [BIN / "sioms", "check", "cell.toml"],
        [BIN / "sioms", "driver", "list"],
        [BIN / "devin", "io0"],
        [BIN / "sdev", "-e"],
    ],
    ids=lambda command: " ".join(Path(word).name for word in command[:3]),
)
def test_commands_import_nothing_from_where_they_are_started(trap: Path, command: list[str | Path]) -> None:
    plant_sioms(trap)
    done = run(trap, *command)
    if "check" in str(command[1]):
        assert done.returncode == 0 and "ok; 2 devices" in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("path", "arguments"),
    [
        (":/nowhere", ["sioms.daemon.main", "--check", "--config", "cell.toml"]),
        (".", ["sioms.tools.front", "driver", "list"]),
        (None, ["sioms.drivers.modbus.simulated.wago", "--help"]),
        (None, ["sioms.sdk.probe", "sim-io", "."]),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_modules_import_nothing_from_where_they_are_run(trap: Path, path: str | None, arguments: list[str]) -> None:
    done = run(trap, sys.executable, "-m", *arguments, path=path)
    assert done.returncode == 0, done.stderr


def test_what_a_program_of_ours_starts_is_started_with_a_safe_path() -> None:
    """Each list that begins with the interpreter goes on with -P, or with -I, which implies it."""
    for folder in ("daemon", "sioms", "tools"):
        for source in (TREE / folder).rglob("*.py"):
            for line in re.findall(r"\[\s*sys\.executable,\s*[^\n]*", source.read_text()):
                assert re.match(r'\[\s*sys\.executable,\s*("-P"|"-IS"|\*program)', line), f"{source}: {line}"
