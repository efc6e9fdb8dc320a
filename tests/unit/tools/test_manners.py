"""What every command does with what is wrong: one table, made of the commands that there are.

A mistyped option, a missing file, a folder in a file's place, no daemon, a number that cannot be: each ends with a
status and a sentence that names what is wrong, and with no traceback.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from recording_rig import write
from tool_rig import parsers

from sioms.tools.front import main

WITHOUT_DAEMON = {
    "bench", "blackbox", "check", "demo", "epics", "init", "metrics", "ros2", "serve", "supervise", "wait",
    "cert authority", "cert install", "cert list", "cert request", "cert sign", "driver check", "driver list",
    "driver replay", "driver trace", "hand demo", "hand friction", "hand record", "hand reproduce", "hand slow",
    "hand trials",
    "key allow", "key list", "key new", "key revoke", "key trust", "log cut", "log export", "log info", "log merge",
    "log plot", "mount", "replay", "reconcile axis", "reconcile describe", "reconcile effects", "reconcile force",
    "reconcile hand", "reconcile score", "reconcile selftest", "reconcile tactile", "reconcile watch",
    "service install", "service remove", "tactile calibrate", "tactile design", "tactile experiment",
    "tactile reproduce", "tactile score", "tactile shape",
}  # fmt: skip
"""Commands that work without a daemon, wait for it, or ask something else first."""
READS = {"file", "files", "config", "data", "truth", "trace"}
"""Arguments that are files or folders to be read."""
BY_DAEMON = {"check", "driver trace"}
"""Those whose file the daemon reads; it says the same."""
GIVEN = {
    "folder": "no-such-folder", "name": "eva", "public": "x" * 40, "address": "lab:1", "node": "mod0", "nodes": "mod0",
    "names": "E1", "drivers": "tmcl", "device": "mod0", "words": "mod0", "of": "axis", "kind": "axis",
}  # fmt: skip
"""What the other arguments get; a new one is to be listed."""


def leaves() -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of all commands that can be called, by their words."""
    return {
        words: parser for words, parser in parsers().items()
        if not any(isinstance(action, argparse._SubParsersAction) and action.required for action in parser._actions)
    }  # fmt: skip


def line(words: str, parser: argparse.ArgumentParser, read: str, written: str) -> list[str]:
    """Return a command line with all that must be given."""
    given = words.split()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            continue
        if action.option_strings:
            if action.required:
                given += [action.option_strings[-1], read if action.dest in ("model", "finger") else written]
        elif action.dest in READS:
            given.append(read)
        elif action.nargs not in ("?", "*"):
            given.append(GIVEN[action.dest])
        else:
            assert action.choices or action.dest in GIVEN, f"{words}: {action.dest} is not listed"
    return given


def reading() -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the commands that are told what to read."""
    for words, parser in leaves().items():
        if words not in BY_DAEMON and any(a.dest in READS and not a.option_strings for a in parser._actions):
            yield words, parser


@pytest.fixture(autouse=True)
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in an empty folder, without a daemon, with keys of one's own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SIOMS_SOCKET", str(tmp_path / "none.sock"))
    monkeypatch.setenv("SIOMS_KEYS", str(tmp_path / "keys"))
    for name in ("XDG_CONFIG_HOME", "XDG_STATE_HOME", "HOME"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    monkeypatch.delenv("SIOMS_CELL", raising=False)


def ends(words: list[str]) -> int:
    """Run a command; return its status."""
    try:
        return main(words)
    except SystemExit as stopped:
        return int(stopped.code or 0)


def test_a_wrong_option_is_answered_with_the_usage_of_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    for words, parser in leaves().items():
        assert ends([*line(words, parser, "x", "x.csv"), "--nonsense"]) == 2, words
        said = capsys.readouterr()
        assert f"usage: sioms {words}" in " ".join(said.err.split()) and "--nonsense" in said.err and not said.out, (
            words
        )


@pytest.mark.parametrize("what", ["missing", "folder"])
def test_a_file_that_cannot_be_read_is_named_in_one_line(capsys: pytest.CaptureFixture[str], what: str) -> None:
    """A folder is read where recordings or records may be one; it is empty here."""
    read = "there-is-no-such.file"
    if what == "folder":
        Path(read).mkdir()
    seen = set()
    for words, parser in reading():
        if words == "init" or (words == "reconcile score" and what == "folder"):
            continue  # writes it; has nothing to score
        status = ends(line(words, parser, read, "picture.png" if words == "log plot" else "table.csv"))
        said = capsys.readouterr().err
        assert status in (1, 2) and read in said and said.count("\n") == 1, f"{words}: {status} {said}"
        seen.add(words)
    assert {"log info", "replay", "blackbox", "cert sign", "reconcile axis", "tactile shape", "hand slow"} <= seen


def test_where_no_daemon_is_that_is_said_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for words, parser in leaves().items():
        if words not in WITHOUT_DAEMON:
            assert ends(line(words, parser, "x", "x.mcap")) == 1, words
            said = capsys.readouterr().err
            assert "no daemon listens there" in said and said.count("\n") == 1, f"{words}: {said}"


def test_numbers_that_cannot_be_are_errors_of_use() -> None:
    """No option takes any number that Python can read: not nan, and none that ends in a traceback for its size."""
    looked_at = 0
    for words, parser in parsers().items():
        for action in parser._actions:
            if action.type is None or action.type is Path:
                continue
            looked_at += 1
            for text in ("nan", "", "x", "-inf", "1e400", "9" * 20):
                if text == "1e400" and action.dest == "indenters":
                    continue  # a flat
                with pytest.raises((argparse.ArgumentTypeError, OSError)):
                    action.type(text)  # type: ignore[operator]
                    pytest.fail(f"{words} {action.option_strings}: {text!r} is taken")
    assert looked_at > 50


@pytest.mark.parametrize("folder", ["", "no-such-folder/"])
def test_an_output_that_cannot_be_written_is_named(capsys: pytest.CaptureFixture[str], folder: str) -> None:
    write(Path("a.mcap"), 20)
    for action, ending in (("cut", "mcap"), ("merge", "mcap"), ("plot", "png"), ("export", "csv")):
        node = ["mod0"] if action == "export" else []
        target = f"{folder}a.{ending}" if folder else ""
        assert ends(["log", action, "a.mcap", *node, "-o", target]) == 1
        said = capsys.readouterr().err
        assert said.startswith(f"sioms log: write {target or repr('')}: ") and said.count("\n") == 1, said
    assert sorted(os.listdir()) == ["a.mcap"]


def test_a_picture_of_an_unknown_kind_and_a_part_of_nothing_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("a.mcap"), 20)
    assert ends(["log", "plot", "a.mcap", "-o", "a.xyz"]) == 1
    assert "want a name that ends in .png, .svg, .pdf" in capsys.readouterr().err
    assert ends(["log", "export", "a.mcap", "mod0", "-o", "b.csv", "--from", "1", "--to", "0"]) == 1
    assert "nothing is between --from 1 and --to 0 s" in capsys.readouterr().err
    assert sorted(os.listdir()) == ["a.mcap"]
