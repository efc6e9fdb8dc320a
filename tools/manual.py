"""What the tools say about themselves: ``--help`` and the manual pages, out of the table of options. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .options import ALL, NODE, TOOLS, Option


@dataclass(frozen=True, slots=True)
class Manual:
    """The words about a pipe tool.

    Attributes:
        does: one line for the name section.
        synopsis: usage lines without the tool's name.
        text: paragraphs.
        examples: (what, command line).
    """

    does: str
    synopsis: Sequence[str]
    text: Sequence[str]
    examples: Sequence[tuple[str, str]]


DEVICES = (
    "A device is a node of the workcell (see `sioms list`). A path, or a symbolic link in the current folder, denotes "
    "the node named by its last component after all links are resolved, so that `ln -s ~rws/dev/mod0 m0` renames a "
    "device. An option of the first group below applies to the device that follows it on the command line."
)
MANUALS: dict[str, Manual] = {
    "devin": Manual(
        "read devices and print their state",
        ["[-l#h#n#pvfmNVrt#.#L#] DEVICE [[-l#h#n#pvfmNV] DEVICE]..."],
        [
            DEVICES,
            "Without options, devin prints one line for each structure of each device: for axes the number, the "
            "is-moving "
            "flag, position, velocity and motor force; for analog and binary devices the number and the data. If "
            "any of p, v, f, m or N is given, only the given items are printed; without N there is no newline. Units "
            "are "
            "SI.",
            "With -r, -t or -L the output is timed: a stream of numbers, each followed by a blank, flushed with every "
            "sample. Samples are taken on an absolute schedule. A sample that is late by more than a period is skipped "
            "and does not count. With -N anywhere, each sample is a line that begins with the time since the "
            "first sample in seconds and the number of the sample on the schedule. On a busy machine a steady period "
            "requires real-time priority, if permitted: chrt -f 1 devin ...",
            "A value that is flagged invalid is printed as nan.",
            "--record prints a table for programs: a header with names and units, then one line for each reading that "
            "the driver publishes, without duplicates, with the driver's timestamp. The record of an axis can be read "
            "by "
            "`sioms reconcile axis` directly.",
            "Reading requires no ownership: an output node is read through its read-only companion, also while another "
            "program owns it. If a device is lost, hangs or is in fault, devin exits with an error; stale data are "
            "never "
            "printed.",
        ],
        [
            ("the state of a module", "devin mod0"),
            ("several devices", "devin mod0 gripper0 atod0"),
            ("a bare number", "devin -p atod0"),
            ("position of axis 0, with its number", "devin -n0pN mod0"),
            ("velocities of axes 1 to 3", "devin -l1h3v mod0"),
            ("record ten seconds of an axis at 1 kHz", "devin --record -L10000 mod0.xaxis > run.csv"),
            (
                "a damper: 500 samples at 20 Hz into a velocity",
                "devin -t0.05 -n0 -L500 lord1 | devout -rv -L-1 -W mod0.xaxis",
            ),
        ],
    ),
    "devout": Manual(
        "write a stream of numbers to devices",
        ["[-l#h#n#rpvfajtsm] DEVICE... [#.##]... < FILE"],
        [
            DEVICES,
            "Numbers are taken from the command line, then from standard input, until there are enough for all "
            "devices; then they are written. An axis takes, regardless of the order of its letters: position, "
            "velocity, "
            "acceleration, jerk, force, force velocity, force offset, time, wait marker, signal marker; the numbers "
            "of each axis follow those of the preceding axis. Analog and binary devices take one number for each "
            "structure. Units are SI.",
            "A command without a time lasts until the next one arrives, which replaces it immediately. Commands with "
            "times "
            "or markers are queued in the axis's buffer and executed in order; while the buffer is full, devout "
            "blocks. Position and velocity together pass the position at that velocity.",
            "At the end of the input devout waits until the axes are idle, except for motion without an end (a "
            "velocity, acceleration, jerk or force without a time), and then closes the devices. Closing halts the "
            "axes, as does the end of devout for any reason, including SIGKILL.",
            "Outputs of analog and binary devices take their safe values when the device is closed and whenever devout "
            "ends: `devout gripper0 1` closes a gripper for a moment only. With -H devout does not exit at the end of "
            "the "
            "input but holds outputs and motion until it is interrupted or killed.",
            "With --lease=# the drivers halt the axes if no row arrives for that time, whether devout hangs or the "
            "program before it in the pipe.",
            "A word that is not a finite number stops devout with an error that gives the line and the word, as in a "
            "stream without lines the meaning of the following numbers is uncertain. With --skip-bad-lines the line is "
            "skipped instead, unless the word is nan. Input that ends within an iteration is an error. devout ends "
            "immediately if a command is refused, at an emergency stop, and if a device or the daemon is lost.",
        ],
        [
            ("move an axis and wait", "devout mod0.xaxis 0.1"),
            ("close the gripper and hold it until Ctrl-C", "devout -H gripper0 1"),
            ("hold it while something else is done", "devout -H gripper0 1 & sleep 5; kill $!"),
            ("segments of velocity and time from a file", "devout -rvt -L-1 mod0.xaxis < pieces.txt"),
            ("move, then signal a marker", "devout -ps mod0.xaxis 0.2 $(smarkers -r)"),
        ],
    ),
    "sdev": Manual(
        "send requests to devices",
        ["[-zsewcg] [#.##]... DEVICE [[-zsewcg] DEVICE]... [< FILE]"],
        [
            DEVICES,
            "Devices are processed in the order of the command line, and the letters of each in the order given. "
            "Numbers "
            "may be anywhere; -c takes one per axis, -g n*n, first from the command line, then from standard input. "
            "All "
            "are checked before anything is executed.",
            "-e is executed before everything else and requires no ownership. It stops all motion at maximum "
            "deceleration, "
            "sets forces to zero, empties the command buffers and is latched: writes are refused until `sioms reset`. "
            "Without a device it stops the whole workcell. It is a software stop, not a safety-rated function.",
            "-s, -e and -w use the read-only companion, so they also work on a device that another program owns. -z, "
            "-c "
            "and -g on an output require ownership.",
        ],
        [
            ("stop everything", "sdev -e"),
            ("start what waits for the synch on two modules at the same instant", "sdev -s mod0 -s mod1"),
            ("wait until a module is idle", "sdev -w mod0"),
            ("set the positions of the axes", "sdev -c 0 0 0.05 0 mod0"),
            ("take the present load as zero", "sdev -z lord1"),
            ("set a gain matrix", "sdev -g tactile0 < gains.txt"),
        ],
    ),
    "smarkers": Manual(
        "reserve, free, signal and wait for markers",
        ["-r [COUNT]", "[-fsw] MARKER..."],
        [
            "A marker is a one-shot event: it is signalled once, by smarkers -s or by a command of an "
            "axis, and from then on all waits for it return immediately.",
            "-r prints one token per line: number and key of a marker in one integer. Freeing and signalling require "
            "the token; for waiting, the number (token modulo 1024) is sufficient. Markers reserved in this way "
            "persist until they are freed.",
        ],
        [
            ("reserve one", "M=$(smarkers -r)"),
            ("have an axis signal it", "devout -ps mod0.xaxis 0.2 $M"),
            ("wait for it, then free it", "smarkers -w $M && smarkers -f $M"),
        ],
    ),
}
DAEMON_OPTIONS = [
    Option("", "config", "FILE", ALL, "configuration (TOML)"),
    Option("", "socket", "PATH", ALL, "where to listen, instead of the configured or default path"),
    Option("", "check", "", ALL, "check the configuration and exit"),
    Option("", "log-level", "LEVEL", ALL, "debug, info, warning or error; default info"),
    Option("", "help", "", ALL, "print help"),
]
STATUS = "0 on success; 1 after a failure, 2 after a wrong command line, each with one line on standard error."
VARIABLES = (
    "SIOMS_CELL is the workcell: the path of a socket, or zmq://HOST:PORT or zenoh://HOST:PORT of a gateway on another "
    "machine. Without it, "
    "SIOMS_SOCKET is the daemon's socket; else /run/sioms/siomsd.sock, else one in the user's runtime folder."
)


def answer(tool: str, wanted: str) -> int:
    """Print the help or the version; return the exit status."""
    if wanted == "version":
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"{tool} (SIOMS) {version('sioms')}")
        except PackageNotFoundError:
            print(f"{tool} (SIOMS)")
    else:
        print(help_text(tool), end="")
    return 0


def help_text(tool: str) -> str:
    """Return what ``--help`` prints."""
    from textwrap import fill

    manual = MANUALS[tool]
    lines = [f"{'usage:' if i == 0 else '   or:'} {tool} {line}" for i, line in enumerate(manual.synopsis)]
    lines += ["", f"{tool}: {manual.does}.", ""]
    for paragraph in manual.text:
        lines += [fill(paragraph, 100), ""]
    for title, options in option_groups(tool):
        lines.append(f"{title}:")
        lines += [fill(o.text, 100, initial_indent=f"  {shape(o):<32}", subsequent_indent=" " * 34) for o in options]
        lines.append("")
    lines.append("examples:")
    lines += [f"  {command}\n      {what}" for what, command in manual.examples]
    return "\n".join([*lines, "", fill(f"Exit status: {STATUS} {VARIABLES}", 100), ""])


def option_groups(tool: str) -> list[tuple[str, list[Option]]]:
    """Return the options of a tool by what they hold for, with a title for each group."""
    groups = [
        ("options for the device that follows", [o for o in TOOLS[tool] if o.scope == NODE]),
        ("options for the whole command line", [o for o in TOOLS[tool] if o.scope == ALL]),
    ]
    general = [
        Option("", "help", "", ALL, "print this help"),
        Option("", "version", "", ALL, "print the version"),
    ]
    found = [(title, options) for title, options in groups if options]
    found[-1][1].extend(general)
    return found


def shape(option: Option) -> str:
    """Return how an option is written, e.g. ``-t#, --period=SECONDS``."""
    long = f"--{option.long}={option.value}" if option.value else f"--{option.long}"
    return f"-{option.letter}{'#' if option.value else ''}, {long}" if option.letter else f"    {long}"
