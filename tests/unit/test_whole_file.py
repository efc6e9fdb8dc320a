"""Files that people keep are whole, whatever happens while they are written."""

from __future__ import annotations

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
