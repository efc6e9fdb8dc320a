"""A stream of numbers in text: lines are counted, wrong words named."""

from __future__ import annotations

import pytest

from sioms.tools.tokens import MAX_TOKEN, Tokens


def fed(*pieces: bytes, skip: bool = False) -> Tokens:
    tokens = Tokens(skip)
    for piece in pieces:
        tokens.feed(piece)
    return tokens


def test_numbers_and_lines():
    assert fed(b"1 2\n-3e-1\r\n\n .5\t7 ", b"").numbers == [(1, 1), (2, 1), (-0.3, 2), (0.5, 4), (7, 4)]


def test_a_word_without_its_end_waits_for_it():
    tokens = fed(b"1 2")
    assert tokens.numbers == [(1, 1)]
    tokens.feed(b"5\n")
    assert tokens.numbers == [(1, 1), (25, 1)]


@pytest.mark.parametrize("word", ["foo", "nan", "inf", "-infinity", "1_0", "0x10", "1,5", "\u0663", "\ufeff1"])
def test_a_wrong_word_ends_the_stream_behind_the_numbers_before_it(word):
    tokens = fed(b"1 2\n3 ", word.encode() + b" 4\n5\n")
    assert [value for value, _ in tokens.numbers] == [1, 2, 3]
    assert tokens.bad.startswith("line 2: ")
    assert "not a finite number" in tokens.bad


def test_bad_lines_are_left_out_whole_when_asked():
    tokens = fed(b"1 2\n3 foo 4\n5 6\ninf\n7 8", b"", skip=True)
    assert [value for value, _ in tokens.numbers] == [1, 2, 5, 6, 7, 8]
    assert [text.split(":")[0] for text in tokens.skipped] == ["line 2", "line 4"]
    assert not tokens.bad


def test_a_word_without_end_is_refused_before_it_fills_the_memory():
    assert "without a separator" in fed(b"1" * (MAX_TOKEN + 1)).bad


@pytest.mark.parametrize("word", [b"nan", b"NaN", b"-nan"])
def test_a_value_that_is_not_known_is_never_skipped(word):
    """devin prints nan for what is no measurement; a velocity that was written before it must not go on."""
    tokens = fed(b"1\n", word + b"\n2\n", skip=True)
    assert [value for value, _ in tokens.numbers] == [1.0]
    assert tokens.bad == f"line 2: '{word.decode()}' is not a finite number" and not tokens.skipped
