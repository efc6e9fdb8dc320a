"""Manual pages and completions: fresh, complete, and free of what their readers would stumble over."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys

import pytest

from sioms.tools.front import COMMANDS
from sioms.tools.generate import TREE, files, roff
from sioms.tools.manual import DAEMON_OPTIONS, help_text
from sioms.tools.options import TOOLS

FILES = files()


@pytest.mark.parametrize("path", FILES)
def test_the_files_in_the_tree_are_the_generated_ones(path):
    assert (TREE / path).read_text() == FILES[path], "run python -m sioms.tools.generate"


@pytest.mark.parametrize("tool", TOOLS)
def test_every_option_is_in_help_manual_and_completions(tool):
    for option in TOOLS[tool]:
        assert f"--{option.long}" in help_text(tool)
        assert roff(f"--{option.long}") in FILES[f"docs/man/{tool}.1"]
        for shell in ("sioms.bash", "_sioms"):
            assert f"--{option.long}" in FILES[f"etc/completion/{shell}"]
        assert f"-l {option.long}" in FILES["etc/completion/sioms.fish"]


def test_every_command_is_in_manual_and_completions():
    for name in COMMANDS:
        assert f".B {name}\n" in FILES["docs/man/sioms.1"]
        assert all(name in FILES[f"etc/completion/{shell}"] for shell in ("sioms.bash", "_sioms", "sioms.fish"))


def test_the_options_of_the_daemon_are_those_that_it_takes():
    told = subprocess.run(
        [sys.executable, "-m", "sioms.daemon.main", "--help"], capture_output=True, text=True, check=True
    ).stdout
    assert set(re.findall(r"--[a-z-]+", told)) == {f"--{option.long}" for option in DAEMON_OPTIONS}


@pytest.mark.skipif(shutil.which("groff") is None, reason="no groff here")
@pytest.mark.parametrize("path", [path for path in FILES if path.startswith("docs/man")])
def test_groff_has_nothing_to_say(path):
    done = subprocess.run(["groff", "-man", "-ww", "-Tutf8", "-z", TREE / path], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_bash_takes_the_completion_and_completes():
    script = (
        "source etc/completion/sioms.bash; sioms() { printf 'mod0\\nmod0.xaxis\\n'; }; "
        "COMP_WORDS=(devin mod0.); COMP_CWORD=1; _sioms_tool devin; echo ${COMPREPLY[@]}; "
        "COMP_WORDS=(devin --per); _sioms_tool devin; echo ${COMPREPLY[@]}; "
        "COMP_WORDS=(sioms rel); _sioms; echo ${COMPREPLY[@]}"
    )
    done = subprocess.run(["bash", "-c", script], cwd=TREE, capture_output=True, text=True)
    # compopt has nothing to act on outside of a real completion, and says so.
    assert done.stdout.split() == ["mod0.xaxis", "--period=", "reload"]
