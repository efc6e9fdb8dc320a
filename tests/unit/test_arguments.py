"""Numbers on a command line."""

from __future__ import annotations

import argparse

import pytest

from sioms.arguments import place, positive, seconds, whole
from sioms.reconcile.command import main
from sioms.tools.front import main as front


def test_numbers_that_make_sense_are_read() -> None:
    assert whole()("0") == 0
    assert whole(1)("20") == 20
    assert positive("2.5e-3") == 2.5e-3


@pytest.mark.parametrize("text", ["-3", "0.5", "abc", ""])
def test_what_is_no_count_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="must be an integer >= 0"):
        whole()(text)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "abc"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="must be a number > 0"):
        positive(text)


@pytest.mark.parametrize("text", ["inf", "-inf", "nan", "1e300", "-1.1e9", "", "soon"])
def test_what_is_no_time_is_refused(text: str) -> None:
    assert seconds("-2.5") == -2.5
    with pytest.raises(argparse.ArgumentTypeError, match="must be a time in seconds"):
        seconds(text)


@pytest.mark.parametrize("option", [("--from", "inf"), ("--to", "nan"), ("--from=-inf",)])
@pytest.mark.parametrize("action", ["cut", "export", "plot"])
def test_a_part_of_a_recording_has_a_finite_beginning_and_end(
    action: str, option: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        front(["log", action, "no.mcap", "-o", "other.mcap", *option])
    assert stopped.value.code == 2
    assert "must be a time in seconds" in capsys.readouterr().err


def test_places_to_listen_at_are_read() -> None:
    assert place("*:5770", "") == ("*", 5770)
    assert place("[::1]:80", "") == ("::1", 80)


@pytest.mark.parametrize("text", ["5770", ":5770", "a:0", "a:65535", "a:-1", "a:x", ""])
def test_what_is_no_place_is_refused(text: str) -> None:
    with pytest.raises(OSError, match=r"want HOST:PORT, as 127.0.0.1:1 or \*:1"):
        place(text, "127.0.0.1:1")


@pytest.mark.parametrize(
    "command",
    [
        ("axis", "run", "--jobs", "-3"),
        ("axis", "run", "--seed", "-1"),
        ("axis", "mod0.xaxis", "--lap", "0"),
        ("selftest", "--axes", "0"),
        ("tactile", "tactile0", "--model", "m.toml", "--step", "0"),
        ("force", "force0", "--model", "m.toml", "--rest", "-5"),
    ],
)
def test_a_number_that_makes_no_sense_is_an_error_of_use(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(list(command))
    assert stopped.value.code == 2
    assert command[-2] in capsys.readouterr().err
