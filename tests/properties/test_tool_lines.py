"""Command lines and streams of numbers in any grouping and any pieces."""

from __future__ import annotations

import contextlib
import itertools

from hypothesis import given
from hypothesis import strategies as st

from sioms.tools.options import COUNT, DIGITS, INDEX, SECONDS, TOOLS, HelpWanted, Option, UsageError, scan
from sioms.tools.tokens import Tokens

VALUES = {
    INDEX: st.integers(0, 1000),
    COUNT: st.integers(-1, 1000),
    SECONDS: st.floats(1e-6, 1e6),
    DIGITS: st.integers(0, 16),
}


@st.composite
def flag(draw: st.DrawFn, options: list[Option]) -> tuple[Option, str, float]:
    option = draw(st.sampled_from(options))
    text = repr(draw(VALUES[option.value])) if option.value else ""
    return option, text, float(text or 0)


@given(st.data())
def test_flags_mean_the_same_in_any_grouping(data):
    tool = data.draw(st.sampled_from(sorted(TOOLS)))
    flags = data.draw(st.lists(flag(TOOLS[tool]), max_size=8))
    words: list[str] = []
    open_group = False
    for option, text, _ in flags:
        if option.letter and data.draw(st.booleans()):
            if open_group and data.draw(st.booleans()):
                words[-1] += option.letter + text
            else:
                words.append(f"-{option.letter}{text}")
            open_group = True
        else:
            words.append(f"--{option.long}" + (f"={text}" if option.value else ""))
            open_group = False
    assert [(i.text, i.value) for i in scan(tool, words)] == [(o.key, value) for o, _, value in flags]


@given(st.sampled_from(sorted(TOOLS)), st.lists(st.text(max_size=8), max_size=5))
def test_any_words_are_read_or_refused(tool, words):
    with contextlib.suppress(UsageError, HelpWanted):
        for item in scan(tool, words):
            assert item.kind in ("flag", "number", "name")


@given(st.text("0123456789.eE+- \n\tx", max_size=80), st.lists(st.integers(0, 80), max_size=8), st.booleans())
def test_any_cut_of_a_stream_gives_the_same_numbers(text, cuts, skip):
    data = text.encode()
    whole = Tokens(skip)
    whole.feed(data)
    whole.feed(b"")
    pieces = Tokens(skip)
    edges = sorted({0, len(data), *[c for c in cuts if c < len(data)]})
    for low, high in itertools.pairwise(edges):
        pieces.feed(data[low:high])
    pieces.feed(b"")
    assert (pieces.numbers, pieces.bad, pieces.skipped) == (whole.numbers, whole.bad, whole.skipped)
