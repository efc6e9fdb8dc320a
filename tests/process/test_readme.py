"""What the README shows works as it stands: its first session pasted into a shell, its script, its configuration."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
BIN = Path(sys.executable).parent
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?")


def block(kind: str, after: str) -> str:
    """Return the first block of a kind behind a heading."""
    found = re.search(rf"^## {after}$.*?^```{kind}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    assert found is not None, f"README has no block {kind} behind {after}"
    return found[1]


def commands(text: str) -> list[str]:
    return [line.removeprefix("$ ") for line in text.splitlines() if line.startswith("$ ")]


@pytest.mark.timeout(180)
def test_the_first_session_works_when_it_is_pasted(tmp_path: Path) -> None:
    lines = commands(block("console", "A first session"))
    activate, *rest = lines
    assert activate == ". .venv/bin/activate"
    script = "\n".join(["set -eo pipefail", f"PATH={shlex.quote(str(BIN))}:$PATH", *rest, "kill %1", "wait %1"])
    environment = {
        **os.environ, "SIOMS_SOCKET": str(tmp_path / "d.sock"), "XDG_RUNTIME_DIR": str(tmp_path),
        "SIOMS_STATE": str(tmp_path),
    }  # fmt: skip
    done = subprocess.run(
        ["bash", "-mc", script], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=150,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    shown = re.findall(r"^[0-3] 0 \S+ \S+ \S+$", block("console", "A first session"), re.MULTILINE)
    assert len(shown) == 4 and "\n".join(shown) in done.stdout
    assert "arrived" in done.stdout and "workcell demo" in done.stdout
    assert re.search(r"^mod0 +axis +4 ", done.stdout, re.MULTILINE)


@pytest.mark.timeout(90)
def test_the_script_runs_on_the_demo(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(block("python", "A control script"))
    script = "siomsd --config etc/demo.toml & sioms wait; python3 -P $S; status=$?; kill %1; wait %1; exit $status"
    environment = {
        **os.environ, "SIOMS_SOCKET": str(tmp_path / "d.sock"), "PATH": f"{BIN}:{os.environ['PATH']}",
        "S": str(tmp_path / "script.py"), "XDG_RUNTIME_DIR": str(tmp_path),
    }  # fmt: skip
    done = subprocess.run(
        ["bash", "-mc", script], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=80
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    stamp, position = done.stdout.split()[-2:]
    assert int(stamp) > 0 and float(position) == pytest.approx(0.2, abs=1e-3)


def test_the_configuration_is_good(tmp_path: Path) -> None:
    (tmp_path / "cell.toml").write_text(block("toml", "A configuration"))
    command = [sys.executable, "-m", "sioms.daemon.main", "--check", "--config", str(tmp_path / "cell.toml")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_link_leads_somewhere() -> None:
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    broken = []
    for page in pages:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
            if "://" not in target and not (page.parent / target).exists():
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert not broken, "\n".join(broken)


def test_every_command_that_a_page_shows_is_known() -> None:
    """``sioms COMMAND`` in code of the documents must be a command, and its first word of an action one, too."""
    from sioms.tools.front import installed

    known = installed()
    wrong = []
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        text = page.read_text()
        code = re.findall(r"`([^`\n]+)`", text) + re.findall(r"^(?:\$ |    )?(sioms .*)$", text, re.MULTILINE)
        for line in code:
            if (found := re.match(r"sioms ([a-z][a-z-]*)(?= |$)", line)) and found[1] not in known:
                wrong.append(f"{page.relative_to(ROOT)}: {line}")
    assert not wrong, "\n".join(wrong)


def test_the_reconcile_example_says_what_it_says(tmp_path: Path) -> None:
    (line,) = [one for one in commands(README) if one.startswith("sioms reconcile axis")]
    words = line.partition("#")[0].split()[1:]
    words[words.index("report")] = str(tmp_path / "report")
    done = subprocess.run([BIN / "sioms", *words], capture_output=True, text=True, timeout=110, cwd=ROOT)
    assert "verdict: named" in done.stdout, done.stdout + done.stderr
    shown = README.partition(line)[2].partition("\n$ ")[0].strip().splitlines()
    assert [each.partition(":")[0].split()[0] for each in shown] == ["verdict", "Stribeck", "where", "why", "model"]
    said = {_NUMBER.sub("#", each): each for each in done.stdout.splitlines()}
    for each in shown:
        assert _NUMBER.sub("#", each) in said, f"{each!r}; it says:\n{done.stdout}"
        numbers = [float(n) for n in _NUMBER.findall(said[_NUMBER.sub("#", each)])]
        assert [float(n) for n in _NUMBER.findall(each)] == pytest.approx(numbers, rel=0.02)
