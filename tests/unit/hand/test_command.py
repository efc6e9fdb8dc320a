"""The command line of the hand: each verb of its table is there, and what cannot be is one sentence."""

from __future__ import annotations

import argparse

import pytest

from sioms.hand.command import VERBS, add_parser, run


def _words(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers(dest="command"))
    return parser.parse_args(["hand", *words])


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        _words(verb, "--help")
    assert end.value.code == 0
    assert VERBS[verb].text.split()[0].capitalize() in capsys.readouterr().out


def test_trials_count_what_becomes_of_objects(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(_words("trials", "--count", "1")) == 0
    out = capsys.readouterr().out
    assert "disk" in out and "held" in out and "all       100.0 %" in out


def test_no_trials_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(_words("trials", "--count", "0")) == 1
    assert "want 1 or more" in capsys.readouterr().err
