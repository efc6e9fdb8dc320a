"""The options of the pipe tools: one table, and the parser that reads a command line by it. Pure.

The grammar is the one of the dissertation's section F.4, which no framework knows: groups of letters
with numbers glued to them (``-l1h3v``, ``-t0.05``), groups that hold for the device that follows
them, numbers among the arguments. ``--help``, the manual pages and the completions come out of the
same table. Nothing is imported here, because every start of a tool pays for it.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

INDEX, COUNT, SECONDS, DIGITS = "INDEX", "COUNT", "SECONDS", "DIGITS"
NODE, ALL = "node", "all"


class UsageError(Exception):
    """The command line cannot be understood; one sentence."""


class HelpWanted(Exception):
    """Somebody asked for ``--help`` or ``--version``; its argument says which."""


class Option:
    """One option of a tool.

    Attributes:
        letter: its short form, '' when it has none.
        long: its long form, without the dashes.
        value: what number is glued to it, '' for none.
        scope: NODE, it holds for the device that follows; ALL, for the whole command line.
        text: what it does.
    """

    __slots__ = ("letter", "long", "scope", "text", "value")

    def __init__(self, letter: str, long: str, value: str, scope: str, text: str) -> None:
        self.letter = letter
        self.long = long
        self.value = value
        self.scope = scope
        self.text = text

    @property
    def key(self) -> str:
        """Its letter, or its long form where it has no letter."""
        return self.letter or self.long


def _range(verb: str, what: str) -> list[Option]:
    return [
        Option("l", "from", INDEX, NODE, f"start {verb} at {what} INDEX"),
        Option("h", "to", INDEX, NODE, f"stop {verb} at {what} INDEX, this one included"),
        Option("n", "only", INDEX, NODE, f"{what} INDEX only"),
    ]


TOOLS: dict[str, list[Option]] = {
    "devin": [
        Option("p", "position", "", NODE, "print the position of axes, the data of other nodes"),
        Option("v", "velocity", "", NODE, "print the velocity of axes"),
        Option("f", "force", "", NODE, "print the motor force of axes"),
        Option("m", "moving", "", NODE, "print the is-moving flag of axes, 0 or 1"),
        Option(
            "N",
            "lines",
            "",
            NODE,
            "begin with the structure number and end with a newline; "
            "in timed output, anywhere: begin each line with its time and sample number",
        ),
        Option("V", "verbose", "", NODE, "print everything with names and units; overrides p, v, f and m"),
        *_range("printing", "structure"),
        Option("r", "repeat", "", ALL, "timed output, one sample a second"),
        Option("t", "period", SECONDS, ALL, "timed output, one sample every SECONDS"),
        Option("L", "count", COUNT, ALL, "timed output of COUNT samples, default 100; -1: unlimited"),
        Option(
            "",
            "record",
            "",
            ALL,
            "print a table of all readings, COUNT of them, for programs: a header with names and units, then "
            "timestamps and values, separated by tabs; with -t one reading every SECONDS",
        ),
        Option("", "digits", DIGITS, ALL, "digits after the point, instead of 4 (position, velocity) and 2 (others)"),
    ],
    "devout": [
        Option("p", "position", "", NODE, "numbers are positions; the default"),
        Option("v", "velocity", "", NODE, "numbers are velocities"),
        Option("a", "acceleration", "", NODE, "numbers are accelerations"),
        Option("j", "jerk", "", NODE, "numbers are jerks"),
        Option("f", "force", "", NODE, "numbers are forces"),
        Option("F", "force-velocity", "", NODE, "numbers are rates of force"),
        Option("o", "force-offset", "", NODE, "a force offset is given"),
        Option("t", "time", "", NODE, "a time is given; -1, also without this option: until the next command"),
        Option("m", "wait-marker", "", NODE, "the number of a marker to wait for is given"),
        Option("s", "signal-marker", "", NODE, "the token of a marker to signal at the end is given"),
        *_range("writing", "structure"),
        Option("r", "repeat", "", ALL, "repeat 100 times or as given by -L, at most to the end of the input"),
        Option("L", "count", COUNT, ALL, "repeat COUNT times; -1: to the end of the input"),
        Option("w", "wait", "", ALL, "wait for the axes after each iteration"),
        Option("W", "no-wait", "", ALL, "do not wait for the axes at the end of the input"),
        Option("H", "hold", "", ALL, "at the end of the input, hold outputs and motion until devout is interrupted"),
        Option("", "lease", SECONDS, ALL, "halt the axes and exit if no row arrives for SECONDS, also if devout hangs"),
        Option(
            "", "skip-bad-lines", "", ALL, "skip lines that contain anything but numbers, instead of stopping there"
        ),
    ],
    "sdev": [
        Option("z", "zero", "", NODE, "define the present position or reading as 0"),
        Option("s", "synch", "", NODE, "send the external synch; all devices with -s start at the same instant"),
        Option(
            "e",
            "emergency-stop",
            "",
            NODE,
            "emergency stop, before anything else; of the whole workcell if no device is given",
        ),
        Option("w", "wait", "", NODE, "wait until the axes are idle"),
        Option("c", "calibrate", "", NODE, "set the positions of the axes, one number per axis, without motion"),
        Option("g", "gains", "", NODE, "set the gain matrix of a tactile array: n*n numbers, row by row"),
        Option("t", "timeout", SECONDS, ALL, "time-out of -w"),
    ],
    "smarkers": [
        Option("r", "reserve", "", ALL, "reserve one marker, or the given number of markers; print their tokens"),
        Option("f", "free", "", ALL, "free the markers; requires their tokens"),
        Option("s", "signal", "", ALL, "signal the markers; requires their tokens"),
        Option("w", "wait", "", ALL, "wait for all markers in turn; the number without the key is sufficient"),
        Option("t", "timeout", SECONDS, ALL, "time-out of -w for all markers together"),
    ],
}

FLAG, NUMBER, NAME = "flag", "number", "name"


class Item:
    """A piece of a command line: a flag with its value, a number, or a name.

    Attributes:
        kind: FLAG, NUMBER or NAME.
        text: key of the flag, or the word.
        value: the number glued to a flag, 0 when there is none.
        scope: of a flag.
    """

    __slots__ = ("kind", "scope", "text", "value")

    def __init__(self, kind: str, text: str, value: float = 0, scope: str = "") -> None:
        self.kind = kind
        self.text = text
        self.value = value
        self.scope = scope

    def __repr__(self) -> str:
        return f"Item({self.kind}, {self.text!r}, {self.value:g})"


class Target:
    """A device on the command line and the flags that hold for it.

    Attributes:
        name: as it was written.
        flags: value by key, in the order in which they were given.
    """

    __slots__ = ("flags", "name")

    def __init__(self, name: str, flags: dict[str, float]) -> None:
        self.name = name
        self.flags = flags

    def channels(self, count: int) -> range:
        """Return the structures chosen by -l, -h and -n out of ``count``.

        Raises:
            UsageError: one that the device has not.

        Example:
            >>> list(Target("mod0", {"l": 1, "h": 3}).channels(4))
            [1, 2, 3]
        """
        flags = self.flags
        if "n" in flags and ("l" in flags or "h" in flags):
            raise UsageError(f"{self.name}: -n and -l, -h exclude each other")
        low = int(flags.get("n", flags.get("l", 0)))
        high = int(flags.get("n", flags.get("h", count - 1)))
        for index in (low, high):
            if not 0 <= index < count:
                raise UsageError(f"{self.name}: structure {index}; want 0 to {count - 1}")
        if low > high:
            raise UsageError(f"{self.name}: -l{low} lies above -h{high}")
        return range(low, high + 1)


class Line:
    """A command line of devices: targets, numbers, and the flags that hold for all.

    Attributes:
        targets: devices in order, each with its own flags.
        numbers: numbers as written, in order.
        common: value by key of the flags for all.
        trailing: flags for a device that no device follows.
    """

    __slots__ = ("common", "numbers", "targets", "trailing")

    def __init__(self) -> None:
        self.targets: list[Target] = []
        self.numbers: list[str] = []
        self.common: dict[str, float] = {}
        self.trailing: dict[str, float] = {}


def scan(tool: str, words: Sequence[str]) -> list[Item]:
    """Split a command line into flags, numbers and names.

    Args:
        tool: key of TOOLS.
        words: the arguments, without the program's name.

    Raises:
        UsageError: an unknown option, or a number missing or not in range.
        HelpWanted: ``--help`` or ``--version`` is among them.

    Example:
        >>> scan("devin", ["-l1h3v", "mod0"])
        [Item(flag, 'l', 1), Item(flag, 'h', 3), Item(flag, 'v', 0), Item(name, 'mod0', 0)]
    """
    options = TOOLS[tool]
    items: list[Item] = []
    open_to_options = True
    for word in words:
        if not open_to_options or word[:1] != "-":
            items.append(Item(NUMBER if is_numeric(word) else NAME, word))
        elif word == "--":
            open_to_options = False
        elif word[:2] == "--":
            items.append(_long(options, word))
        elif is_numeric(word):
            items.append(Item(NUMBER, word))
        else:
            _group(options, word, items)
    return items


def fold(tool: str, words: Sequence[str]) -> Line:
    """Read the command line of a tool for devices; see ``scan`` for what it raises.

    Example:
        >>> line = fold("devout", ["-rv", "-L-1", "-W", "mod0.xaxis", "0.1"])
        >>> line.targets[0].flags, line.common, line.numbers
        ({'v': 0}, {'r': 0, 'L': -1.0, 'W': 0}, ['0.1'])
    """
    line = Line()
    for item in scan(tool, words):
        if item.kind == NUMBER:
            line.numbers.append(item.text)
        elif item.kind == NAME:
            line.targets.append(Target(item.text, line.trailing))
            line.trailing = {}
        elif item.scope == ALL:
            line.common[item.text] = item.value
        else:
            line.trailing[item.text] = item.value
    return line


def is_numeric(word: str) -> bool:
    """Tell whether a word begins like a number: a sign or a point must be followed by a digit.

    Example:
        >>> [is_numeric(w) for w in ("-0.1", ".5", "-r", "./m0", "1e3")]
        [True, True, False, False, True]
    """
    start = 1 if word[:1] in ("+", "-") else 0
    if word[start : start + 1] == ".":
        start += 1
    return word[start : start + 1] in _DIGITS


_DIGITS = frozenset("0123456789")


def number(word: str) -> float:
    """Return the finite number that a word is.

    Raises:
        ValueError: it is none.
    """
    value = float(word)
    if value - value != 0 or "_" in word:
        raise ValueError(f"{word} is not a finite number")
    return value


def _group(options: list[Option], word: str, items: list[Item]) -> None:
    """Take a group of letters apart, each with the number glued to it."""
    by_letter = {option.letter: option for option in options if option.letter}
    at = 1
    if len(word) == 1:
        raise UsageError("- alone is not an option; without numbers, devout reads them from standard input")
    while at < len(word):
        letter = word[at]
        option = by_letter.get(letter)
        if option is None:
            raise UsageError(f"{word}: unknown option -{letter}; there are: {''.join(by_letter)}; try --help")
        at += 1
        value: float = 0
        if option.value:
            end = _number_end(word, at)
            value = _value(option, f"-{letter}", word[at:end])
            at = end
        items.append(Item(FLAG, option.key, value, option.scope))


def _long(options: list[Option], word: str) -> Item:
    name, glue, text = word[2:].partition("=")
    if name in ("help", "version"):
        raise HelpWanted(name)
    for option in options:
        if option.long == name:
            if glue and not option.value:
                raise UsageError(f"{word}: --{name} takes no value")
            value = _value(option, f"--{name}=", text) if option.value else 0
            return Item(FLAG, option.key, value, option.scope)
    raise UsageError(f"{word}: unknown option; there are: {', '.join('--' + o.long for o in options)}, --help")


def _number_end(word: str, at: int) -> int:
    """Return where the number that begins at a place in a group ends."""
    end = at + 1 if word[at : at + 1] in ("+", "-") else at
    start = end
    while end < len(word) and (word[end] in _DIGITS or word[end] == "."):
        end += 1
    exponent = end + 1
    if end > start and word[end : end + 1] in ("e", "E"):
        if word[exponent : exponent + 1] in ("+", "-"):
            exponent += 1
        if word[exponent : exponent + 1] in _DIGITS:
            end = exponent
            while end < len(word) and word[end] in _DIGITS:
                end += 1
    return end


BOUNDS = {
    INDEX: (0, 1 << 20, "an index from 0"),
    COUNT: (-1, 1 << 53, "a count from 0, or -1 for no end"),
    SECONDS: (1e-6, 1e6, "seconds from 0.000001 to 1000000"),
    DIGITS: (0, 16, "0 to 16 digits"),
}


def _value(option: Option, shown: str, text: str) -> float:
    low, high, want = BOUNDS[option.value]
    try:
        value = number(text)
        if not low <= value <= high or (option.value != SECONDS and value != int(value)):
            raise ValueError
    except ValueError:
        hint = "; for help use --help" if shown == "-h" and not text else ""
        raise UsageError(f"{shown}{text}: want {want}, without a space{hint}") from None
    return value
