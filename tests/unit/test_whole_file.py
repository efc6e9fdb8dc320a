"""Files that people keep are whole, whatever happens while they are written."""

from __future__ import annotations

import ast
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from sioms.whole_file import write_whole


def _on_a_full_disk(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python that can write no more than 100 bytes into a file."""
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100)),
    )  # fmt: skip


def test_what_cannot_be_written_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "finger.toml"
    path.write_text("old")
    done = _on_a_full_disk(
        "from pathlib import Path; from sioms.whole_file import write_whole\n"
        "write_whole(Path('finger.toml'), 'new' * 1000)",
        tmp_path,
    )
    assert "write finger.toml: file too large" in done.stderr
    assert path.read_text() == "old"
    assert [each.name for each in tmp_path.iterdir()] == ["finger.toml"]


def test_who_has_the_old_file_open_reads_all_of_it(tmp_path: Path) -> None:
    """The new one takes its place; at no instant is there a file that is half of each."""
    path = tmp_path / "finger.toml"
    path.write_text("old")
    with path.open() as reader:
        write_whole(path, "new and longer")
        assert reader.read() == "old" and path.read_text() == "new and longer"


@pytest.mark.parametrize("there", [False, True])
def test_a_starter_configuration_is_whole_or_not_there(tmp_path: Path, there: bool) -> None:
    path = tmp_path / "cell.toml"
    if there:
        path.write_text("mine = 1\n")
    done = _on_a_full_disk(
        "import sys; from sioms.tools.front import main\nsys.exit(main(['init', '--force', 'cell.toml']))", tmp_path
    )
    assert done.returncode == 1
    assert "write cell.toml: file too large" in done.stderr and "standard output" not in done.stderr
    assert [each.read_text() for each in tmp_path.iterdir()] == (["mine = 1\n"] if there else [])


def test_links_modes_and_what_is_no_file_stay_what_they_are(tmp_path: Path) -> None:
    real, link = tmp_path / "real", tmp_path / "link"
    real.write_text("old")
    real.chmod(0o600)
    link.symlink_to(real)
    write_whole(link, "new")
    assert link.is_symlink() and real.read_text() == "new" and real.stat().st_mode & 0o777 == 0o600
    write_whole(Path("/dev/null"), "gone")
    assert not Path("/dev/null").is_file()
    with pytest.raises(OSError, match=r"write .*/no/such: no such file or directory"):
        write_whole(tmp_path / "no" / "such", "")


TREE = Path(__file__).resolve().parents[2]
DIRECT = {
    "daemon": ("alarms.py",),  # as a whole, in a thread of its own
    "drivers": (),
    "sioms/client": ("keys.py",),  # as a whole, by a folder of its own
    "sioms/gateway": (),
    "sioms/protocol": (),
    "sioms/recording": ("export.py", "rewrite.py", "live/box.py"),  # beside, and renamed; a table has its own name
    "sioms/sdk": ("trace.py",),  # a line at a time
    "sioms/tactile": ("command/shape.py",),  # a table, a line at a time
    "sioms/reconcile": (
        "report/__init__.py", "report/effects.py", "report/effects_sensors.py",  # pages for people
        "command/damaged.py", "command/selftest.py", "command/selftest_sensors.py", "command/__init__.py",
        "live/axis.py", "live/force.py",  # what goes with a record, made anew with it
    ),
    "tools": ("generate.py", "front.py", "demo/story.py", "demo/wire.py"),
}  # fmt: skip
"""Modules that write files with their own hands; simulators and rigs apart."""


def _writes(path: Path) -> bool:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Attribute) and node.func.attr in ("write_text", "write_bytes", "writelines"):
            return True
        name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        modes = [*node.args[:2], *(k.value for k in node.keywords if k.arg == "mode")] if name == "open" else []
        if any(isinstance(m, ast.Constant) and m.value in ("w", "wb", "a", "ab", "x", "xb", "w+", "r+") for m in modes):
            return True
    return False


@pytest.mark.parametrize("folder", DIRECT)
def test_files_that_are_read_again_are_written_as_a_whole(folder: str) -> None:
    """By ``write_whole``, or by one of the parts that have reasons to do otherwise."""
    found = {
        str(path.relative_to(TREE / folder))
        for path in (TREE / folder).rglob("*.py")
        if "simulat" not in str(path) and "driver/rig" not in str(path) and _writes(path)
    }
    assert found == set(DIRECT[folder])


def test_no_file_of_a_folder_is_mapped_into_memory() -> None:
    """Who truncates it, or a full disk, would end the process by SIGBUS; pages are sealed memory without a name."""
    mapping = {
        str(path.relative_to(TREE))
        for folder in DIRECT for path in (TREE / folder).rglob("*.py")
        if "mmap.mmap(" in path.read_text(encoding="utf-8") or "memmap" in path.read_text(encoding="utf-8")
    }  # fmt: skip
    assert mapping == {
        "daemon/devices.py", "daemon/journals.py", "daemon/shared.py", "sioms/recording/live/replay.py",
        "sioms/recording/live/taps.py", "sioms/sdk/inputs.py", "sioms/sdk/pages.py", "sioms/sdk/runtime.py",
    }  # fmt: skip
