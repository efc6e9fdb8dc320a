"""What a session calls itself where its program gives it no name: what was typed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ASK = "from sioms.client.title import title; print(title())"


def told(*words: str, folder: Path | None = None, given: str = "") -> str:
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, timeout=60, cwd=folder, input=given, check=True
    )
    return done.stdout.rstrip("\n")


def test_code_on_the_command_line_is_shown_bounded_and_escaped() -> None:
    assert told("-c", ASK) == 'python -c "from sioms.client.title import title; print(tit…"'
    assert (
        told("-P", "-c", f"# \x1b[2J\n{ASK}", "-c", "more")
        == r"""python -c "# \x1b[2J from sioms.client.title import title;…" """.strip()
    )
    assert told(f"-c{ASK}", "-c").startswith('python -c "from sioms')


@pytest.mark.parametrize("quote", ["'", '"'])
def test_no_literal_of_the_code_is_shown(quote: str) -> None:
    """Names stand in logs, in recordings and in lists of other machines; a literal may be a password."""
    code = f"import sys; word = {quote}secret{quote}; {ASK}"
    assert told("-c", code) == 'python -c "import sys; word =…"'


@pytest.mark.parametrize("argv", ["[]", "['-c']", "['-c'] * 30"])
def test_a_program_that_changes_its_words_has_a_title_yet(argv: str) -> None:
    assert told("-c", f"import sys; sys.argv = {argv}; {ASK}").startswith("python")


def test_scripts_modules_and_standard_input(tmp_path: Path) -> None:
    (tmp_path / "sort.py").write_text(ASK)
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "__main__.py").write_text(ASK)
    assert told(str(tmp_path / "sort.py")) == "sort.py"
    assert told("-m", "pack", folder=tmp_path) == "python -m pack"
    assert told("-", given=ASK) == "python -"
    assert told(given=ASK) == "python"
