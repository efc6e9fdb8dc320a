"""What not everybody needs is not needed by the rest, and is named where it is missing."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parents[2]

CORE = {"msgpack", "msgspec", "numpy", "ruckig", "serial"}
WITHOUT = "import sys\nfor name in ('gpiod', 'matplotlib', 'numba'): sys.modules[name] = None\n"


def python(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)


def test_the_core_imports_little() -> None:
    """Daemon, client, kit and simulated axes: what a small computer has to hold."""
    done = python(
        WITHOUT
        + "import os, sioms, sioms.aio, sioms.daemon.main, sioms.daemon.server, sioms.sdk, sioms.sdk.fork_server\n"
        "import sioms.sdk.runtime, sioms.drivers.sim.axes, sioms.drivers.sim.io, sioms.drivers.tmcl.driver\n"
        "roots = {name.partition('.')[0] for name, m in sys.modules.items() if 'site-packages' in str(getattr(m, "
        "'__file__', ''))}\n"
        "print(*sorted(roots))"
    )
    assert done.returncode == 0, done.stderr
    found = {name for name in done.stdout.split() if not name.startswith("_")}
    assert found - {"typing_extensions"} <= CORE  # which msgspec takes where it is there


def test_every_driver_but_gpio_can_be_described_without_extras() -> None:
    done = python(
        WITHOUT + "from importlib.metadata import entry_points\n"
        "for point in entry_points(group='sioms.drivers'): point.load()\n"
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["tactile", "design"], "report"),
        (["reconcile", "selftest", "--axes", "1"], "fast"),
    ],
)
def test_what_is_missing_is_named(arguments: list[str], extra: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    done = python(WITHOUT + f"from sioms.tools.front import main\nsys.exit(main({arguments!r}))")
    assert done.returncode == 1
    assert f"is not installed; run: pip install 'sioms[{extra}]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_every_extra_that_is_named_is_one() -> None:
    with open(TREE / "pyproject.toml", "rb") as file:
        extras = set(tomllib.load(file)["project"]["optional-dependencies"])
    for folder in ("sioms", "drivers", "daemon", "tools", "docs"):
        for path in sorted((TREE / folder).rglob("*")):
            if path.suffix in (".py", ".md") and not path.is_symlink():
                named = set(re.findall(r"sioms\[(\w+)\]", path.read_text(encoding="utf-8")))
                assert named <= extras, path
