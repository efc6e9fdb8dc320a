"""The command lines of section F.4, read to the letter, and what is said about wrong ones."""

from __future__ import annotations

import pytest

from sioms.tools.options import HelpWanted, Target, UsageError, fold, is_numeric, scan

# Every example line of the section: tool, arguments, targets with flags, common flags, numbers.
EXAMPLES = [
    ("devin", "mod0", [("mod0", {})], {}, []),
    ("devin", "mod0 gripper0 atod0", [("mod0", {}), ("gripper0", {}), ("atod0", {})], {}, []),
    ("devin", "~rws/dev/mod0", [("~rws/dev/mod0", {})], {}, []),
    ("devin", "m0", [("m0", {})], {}, []),
    ("devin", "-p atod0", [("atod0", {"p": 0})], {}, []),
    ("devin", "-n0pN mod0", [("mod0", {"n": 0, "p": 0, "N": 0})], {}, []),
    ("devin", "-l1h3v mod0", [("mod0", {"l": 1, "h": 3, "v": 0})], {}, []),
    ("devin", "-t0.05 -n0 -L500 lord1", [("lord1", {"n": 0})], {"t": 0.05, "L": 500}, []),
    ("devout", "-rv -L-1 -W mod0.xaxis", [("mod0.xaxis", {"v": 0})], {"r": 0, "L": -1, "W": 0}, []),
    ("devout", "mod0 1 -2.5 .5 1e-3", [("mod0", {})], {}, ["1", "-2.5", ".5", "1e-3"]),
    ("sdev", "-c 0.1 -0.2 mod0 -z lord1", [("mod0", {"c": 0}), ("lord1", {"z": 0})], {}, ["0.1", "-0.2"]),
]


@pytest.mark.parametrize(("tool", "line", "targets", "common", "numbers"), EXAMPLES)
def test_example_lines(tool, line, targets, common, numbers):
    read = fold(tool, line.split())
    assert [(t.name, t.flags) for t in read.targets] == targets
    assert (read.common, read.numbers, read.trailing) == (common, numbers, {})


def test_flags_hold_for_the_device_that_follows_and_no_other():
    read = fold("devin", ["-v", "-n1", "mod0", "mod1", "-pN", "mod2"])
    assert [t.flags for t in read.targets] == [{"v": 0, "n": 1}, {}, {"p": 0, "N": 0}]


def test_flags_behind_the_last_device_are_kept_apart():
    assert fold("devin", ["mod0", "-N"]).trailing == {"N": 0}


def test_long_options_mean_the_same_as_short_ones():
    short = fold("devin", ["-t0.5", "-l1", "-h2", "-v", "mod0"])
    long = fold("devin", ["--period=0.5", "--from=1", "--to=2", "--velocity", "mod0"])
    assert (short.common, short.targets[0].flags) == (long.common, long.targets[0].flags)


def test_after_two_dashes_nothing_is_an_option():
    assert [(i.kind, i.text) for i in scan("devout", ["--", "-r", "-1"])] == [
        ("name", "-r"),
        ("number", "-1"),
    ]


@pytest.mark.parametrize("word", ["--help", "--version"])
def test_help_and_version_are_asked_for(word):
    with pytest.raises(HelpWanted):
        fold("smarkers", [word])


@pytest.mark.parametrize(
    ("tool", "words", "said"),
    [
        ("devin", ["-h", "mod0"], "for help use --help"),
        ("devin", ["-x", "mod0"], "unknown option -x"),
        ("devin", ["-l1.5", "mod0"], "want an index from 0"),
        ("devin", ["-n-1", "mod0"], "want an index from 0"),
        ("devin", ["-t0", "mod0"], "want seconds from 0.000001"),
        ("devin", ["-tnan", "mod0"], "want seconds"),
        ("devin", ["-L-2", "mod0"], "-1 for no end"),
        ("devin", ["-t", "0.05", "mod0"], "without a space"),
        ("devin", ["--perod=1", "mod0"], "unknown option"),
        ("devin", ["--velocity=1", "mod0"], "takes no value"),
        ("devin", ["--period", "mod0"], "want seconds"),
        ("devin", ["-", "mod0"], "not an option"),
        ("devout", ["-inf"], "unknown option -i"),
    ],
)
def test_wrong_lines_are_refused_in_a_sentence(tool, words, said):
    with pytest.raises(UsageError, match=said):
        fold(tool, words)


@pytest.mark.parametrize(
    ("flags", "chosen"),
    [
        ({}, [0, 1, 2, 3]),
        ({"l": 1}, [1, 2, 3]),
        ({"h": 1}, [0, 1]),
        ({"l": 1, "h": 3}, [1, 2, 3]),
        ({"n": 2}, [2]),
    ],
)
def test_choice_of_structures(flags, chosen):
    assert list(Target("mod0", flags).channels(4)) == chosen


@pytest.mark.parametrize("flags", [{"n": 4}, {"h": 4}, {"l": 3, "h": 1}, {"n": 1, "l": 0}])
def test_structures_that_are_not_there(flags):
    with pytest.raises(UsageError, match="mod0"):
        Target("mod0", flags).channels(4)


def test_what_begins_like_a_number():
    yes = ["0", "-1", "+1", "-.5", ".5", "+.5", "1abc"]
    no = ["-r", "-", ".", "./m0", "..", "-.", "mod0", "~rws/dev/mod0", "--1", "+", ""]
    assert all(map(is_numeric, yes))
    assert not any(map(is_numeric, no))
