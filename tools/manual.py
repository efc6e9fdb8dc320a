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
    "A device is a node of the workcell (see `sioms list`). Of a path, and of a soft link in the current folder, "
    "the last part counts after all links are followed, so that `ln -s ~rws/dev/mod0 m0` renames a device. "
    "An option of the first group below holds for the one device that follows it on the command line."
)
MANUALS: dict[str, Manual] = {
    "devin": Manual(
        "read devices and print their state",
        ["[-l#h#n#pvfmNVrt#.#L#] DEVICE [[-l#h#n#pvfmNV] DEVICE]..."],
        [
            DEVICES,
            "Without options it prints a line for each structure of each device: for axes the number, the is-moving "
            "flag, position, velocity and motor force; for analog and binary devices the number and the data. When "
            "any of p, v, f, m or N is given, only what is given is printed; without N there is no newline. Units are "
            "SI.",
            "With -r, -t or -L the output is timed: a stream of numbers, each followed by a blank, flushed with every "
            "sample. Samples are taken on an absolute schedule. One whose time has passed when its turn comes is left "
            "out and does not count. With -N anywhere, each sample is a line that begins with the time since the "
            "first sample in seconds and the number of the sample on the schedule. On a busy machine a steady period wants "
            "real-time priority, for those who may: chrt -f 1 devin ...",
            "--record makes a table for programs: one line of names with units, then one line for each reading that the "
            "driver publishes, none twice, with the driver's own time stamp. What it writes of an axis is read by "
            "`sioms reconcile axis` as it is.",
            "Reading disturbs nobody: an output node is read through its read-only companion, also while another "
            "program owns it. A device that is lost, hung or in fault ends devin with an error; old data are never "
            "printed as new.",
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
            "devices; then they are written. An axis takes, whatever the order of its letters: position, velocity, "
            "acceleration, jerk, force, force velocity, force offset, time, wait marker, signal marker; the numbers "
            "of one axis come after those of the axis before it. Analog and binary devices take one number for each "
            "structure. Units are SI.",
            "A command without a time lasts until the next one arrives, which takes over at once. Commands with times "
            "or markers queue up in the axis's buffer and are carried out one after the other; a full buffer holds "
            "devout back. Position and velocity together pass the position at that velocity.",
            "At the end of the input devout waits until the axes stand still, except for motion that has no end (a "
            "velocity, acceleration, jerk or force without a time), and then closes the devices. Closing halts the "
            "axes; so does the end of devout for whatever reason, SIGKILL included.",
            "Outputs of analog and binary devices go to their safe values when the device is closed, as at every end of "
            "devout: `devout gripper0 1` closes a gripper for a moment only. With -H devout stays at the end of the "
            "input and holds outputs and motions until it is interrupted or killed.",
            "With --lease=# the drivers halt the axes when no row has come for that time, be it that the program before "
            "devout in the pipe hangs or devout itself.",
            "A word that is no finite number stops devout with an error that names line and word, because in a stream "
            "without lines nobody can tell which number is meant for what after it. With --skip-bad-lines the line "
            "that holds it is left out instead. Input that ends within an iteration is an error. A refused command, "
            "an emergency stop, and the loss of a device or the daemon end devout at once.",
        ],
        [
            ("move an axis and wait", "devout mod0.xaxis 0.1"),
            ("close the gripper and hold it until Ctrl-C", "devout -H gripper0 1"),
            ("hold it while something else is done", "devout -H gripper0 1 & sleep 5; kill $!"),
            ("pieces of velocity and time from a file", "devout -rvt -L-1 mod0.xaxis < pieces.txt"),
            ("move, then signal a marker", "devout -ps mod0.xaxis 0.2 $(smarkers -r)"),
        ],
    ),
    "sdev": Manual(
        "send requests to devices",
        ["[-zsewcg] [#.##]... DEVICE [[-zsewcg] DEVICE]... [< FILE]"],
        [
            DEVICES,
            "Devices are served in the order of the command line, the letters of each in theirs. Numbers may stand "
            "anywhere; -c takes one an axis, -g n*n, first from the command line, then from standard input. All are "
            "checked before anything is done.",
            "-e comes before everything else and needs no ownership. It stops all motion at maximum deceleration, "
            "takes forces to zero, empties the command buffers and latches: writes are refused until `sioms reset`. "
            "Without a device it stops the whole workcell. It is a software stop, not a safety-rated function.",
            "-s, -e and -w go through the read-only companion and so reach a device that another program owns. -z, -c "
            "and -g on an output need the device for themselves.",
        ],
        [
            ("stop everything", "sdev -e"),
            ("start what waits for the synch on two modules at the same instant", "sdev -s mod0 -s mod1"),
            ("wait until a module is idle", "sdev -w mod0"),
            ("say where the axes are", "sdev -c 0 0 0.05 0 mod0"),
            ("take the present load as zero", "sdev -z lord1"),
            ("set a gain matrix", "sdev -g tactile0 < gains.txt"),
        ],
    ),
    "smarkers": Manual(
        "reserve, free, signal and wait for markers",
        ["-r [COUNT]", "[-fsw] MARKER..."],
        [
            "A marker tells that something has happened: it is signalled once, by smarkers -s or by a command of an "
            "axis, and from then on all waits for it return at once.",
            "-r prints a token for each marker, one a line: number and key in one integer. Freeing and signalling "
            "need the token; for waiting it or the bare number (token modulo 1024) will do. Markers reserved here "
            "stay reserved until they are freed.",
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
    Option("", "log-level", "LEVEL", ALL, "debug, info, warning or error; info unless told"),
    Option("", "help", "", ALL, "print help"),
]
STATUS = (
    "0 on success; 1 after a failure, 2 after a wrong command line, each with one line on standard error."
)
VARIABLES = (
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
        lines += [
            fill(o.text, 100, initial_indent=f"  {shape(o):<32}", subsequent_indent=" " * 34) for o in options
        ]
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
