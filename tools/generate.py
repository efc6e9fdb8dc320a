"""Write what is generated: manual pages (docs/man), shell completions (etc/completion), docs/protocol.md,
docs/records.md, and the table in drivers/README.md.

    python -m sioms.tools.generate           write the files that differ
    python -m sioms.tools.generate --check   write nothing; exit 1 and name the files that differ

Everything comes out of the tables of options, manuals, commands, verbs and columns, so that none of them can lie.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import READ, WRITE, Column

from . import driver
from .front import COMMANDS, DESCRIPTION
from .manual import DAEMON_OPTIONS, MANUALS, STATUS, VARIABLES, option_groups, shape
from .options import TOOLS, Option
from .verb_table import protocol_page

TREE = Path(__file__).resolve().parent.parent
_NODE_COMMANDS = ("info", "monitor", "reset", "stop")


def main() -> int:
    """Write or check the generated files; return the exit status."""
    parser = argparse.ArgumentParser(description="write manual pages and completions")
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 when a file differs")
    check = parser.parse_args().check
    stale = [path for path, text in files().items() if not _is(TREE / path, text)]
    for path in stale:
        if not check:
            (TREE / path).parent.mkdir(parents=True, exist_ok=True)
            (TREE / path).write_text(files()[path], encoding="utf-8")
        print(f"{path}: {'differs; run python -m sioms.tools.generate' if check else 'written'}")
    return 1 if check and stale else 0


def _is(path: Path, text: str) -> bool:
    return path.is_file() and path.read_text(encoding="utf-8") == text


def files() -> dict[str, str]:
    """Return every generated file by its path in the tree."""
    made = {f"docs/man/{tool}.1": tool_page(tool) for tool in TOOLS}
    made["docs/man/sioms.1"] = front_page()
    made["docs/man/sioms-driver.1"] = driver_page()
    made["docs/man/siomsd.8"] = daemon_page()
    made["docs/protocol.md"] = protocol_page()
    made["docs/records.md"] = records_page()
    made["drivers/README.md"] = families_page()
    made["etc/completion/sioms.bash"] = bash()
    made["etc/completion/_sioms"] = zsh()
    made["etc/completion/sioms.fish"] = fish()
    return made


# --- families of drivers -------------------------------------------------------------------------

CLASSES = ("axis", "analog", "binary")
_ROW = re.compile(r"<!-- In drivers/README.md: (\|.*\|) -->")


def families_page() -> str:
    """Return the page of all families: what stands there, with the rows that their own pages have for it."""
    folder = TREE / "drivers"
    rows = []
    for page in sorted(folder.glob("*/*.md")):
        for row in _ROW.findall(page.read_text(encoding="utf-8")):
            family, driver, node_class, *others = (cell.strip() for cell in row.strip("|").split("|"))
            link = f"{driver}, [page]({page.relative_to(folder)})"
            order = CLASSES.index(node_class.partition(",")[0])
            rows.append((order, str(page), f"| {' | '.join([family, link, node_class, *others])} |"))
    text = (folder / "README.md").read_text(encoding="utf-8")
    kept = [line for line in text.splitlines() if not (line.startswith("| ") and "[page](" in line)]
    at = next(i for i, line in enumerate(kept) if line.startswith("| --- ")) + 1
    return "\n".join([*kept[:at], *(row for _, _, row in sorted(rows)), *kept[at:], ""])


# --- records -------------------------------------------------------------------------------------

RECORDS = """# Records

The data written to and read from nodes: one record per channel, little-endian. Generated from
`sioms/protocol/records.py` by `python -m sioms.tools.generate`.

A write consists of any number of contiguous write records. A read is one array per column, in this order, with 8 bytes
per channel and column, in the node's page in shared memory. Units are declared per channel; u is m or rad, f is N or N*m.
`i` and `I` are integers of 4 bytes, `q` of 8 bytes, `d` is a double. A column with a flag is used only if that flag is set
in `control_mode`.
"""  # noqa: E501


def records_page() -> str:
    """Return the page of the records' columns."""
    parts = [RECORDS]
    for verb, tables in (("Write", WRITE), ("Read", READ)):
        for node_class in (NodeClass.AXIS, NodeClass.ANALOG, NodeClass.BINARY):
            rows = [_column_row(column, flagged=verb == "Write") for column in tables[node_class].values()]
            head = (
                "| column | type | unit | flag | meaning |" if verb == "Write" else "| column | type | unit | meaning |"
            )
            rule = "| --- " * (head.count("|") - 1) + "|"
            parts.append("\n".join([f"## {verb} {node_class.name.lower()}", "", head, rule, *rows]) + "\n")
    return "\n".join(parts)


def _column_row(column: Column, *, flagged: bool) -> str:
    flag = [str(ControlMode(column.flag).name) if column.flag else ""] if flagged else []
    cells = [f"`{column.name}`", f"`{column.code}`", column.unit.format(u="u", f="f"), *flag, column.text]
    return f"| {' | '.join(cells)} |"


# --- manual pages --------------------------------------------------------------------------------


def roff(text: str) -> str:
    """Escape text for roff: backslashes, hyphens that must stay hyphens, and lines that look like requests.

    Example:
        >>> roff("-v .5")
        '\\\\-v .5'
    """
    text = text.replace("\\", "\\e").replace("-", "\\-").replace("~", "\\(ti").replace("`", "\\(ga")
    return "\\&" + text if text[:1] in (".", "'") else text


def _page(name: str, section: int, does: str, synopsis: list[str], parts: list[tuple[str, list[str]]]) -> str:
    lines = [
        f'.TH {name.upper()} {section} "" SIOMS "SIOMS manual"', ".SH NAME", f"{name} \\- {roff(does)}", ".SH SYNOPSIS",
    ]  # fmt: skip
    for usage in synopsis:
        lines += [".PP", f".B {name}", roff(usage)]
    for title, body in parts:
        lines += [f".SH {title.upper()}", *body]
    return "\n".join([*lines, ""])


def _paragraphs(texts: tuple[str, ...] | list[str]) -> list[str]:
    return [line for text in texts for line in (".PP", roff(text))]


def _options(options: list[Option]) -> list[str]:
    return [line for o in options for line in (".TP", f".B {roff(shape(o).strip())}", roff(o.text))]


def _see_also(name: str) -> list[str]:
    pages = [*[(tool, 1) for tool in TOOLS], ("sioms", 1), ("sioms-driver", 1), ("siomsd", 8)]
    return [", ".join(f"\\fB{page}\\fR({section})" for page, section in pages if page != name)]


def tool_page(tool: str) -> str:
    """Return the manual page of a pipe tool."""
    manual = MANUALS[tool]
    options: list[str] = []
    for title, group in option_groups(tool):
        options += [f".SS {roff(title[0].upper() + title[1:])}", *_options(group)]
    examples = [line for what, command in manual.examples for line in (".TP", f".B {roff(command)}", roff(what))]
    return _page(
        tool, 1, manual.does, list(manual.synopsis),
        [
            ("description", _paragraphs(list(manual.text))),
            ("options", options),
            ("examples", examples),
            ("exit status", [roff(STATUS)]),
            ("environment", [roff(VARIABLES)]),
            ("see also", _see_also(tool)),
        ],
    )  # fmt: skip


def front_page() -> str:
    """Return the manual page of ``sioms``."""
    commands = [line for name, c in COMMANDS.items() for line in (".TP", f".B {name}", roff(c.text))]
    return _page(
        "sioms", 1, "look at a workcell and command it", ["COMMAND [ARGUMENT]..."],
        [
            ("description", _paragraphs([DESCRIPTION])),
            ("commands", commands),
            ("environment", [roff(VARIABLES)]),
            ("see also", _see_also("sioms")),
        ],
    )  # fmt: skip


def driver_actions() -> dict[str, tuple[str, argparse.ArgumentParser]]:
    """Return the actions of ``sioms driver``: what each does, and its parser."""
    top = argparse.ArgumentParser(prog="sioms").add_subparsers()
    driver.add_parser(top)
    inner = next(a for a in top.choices["driver"]._actions if isinstance(a, argparse._SubParsersAction))
    texts = {action.dest: action.help or "" for action in inner._choices_actions}
    return {name: (texts[name], parser) for name, parser in inner.choices.items()}


def _arguments(parser: argparse.ArgumentParser) -> list[str]:
    """Return the arguments and options of a parser as lines of roff."""
    lines = []
    for action in parser._actions:
        names = ", ".join(action.option_strings)
        value = "" if action.nargs == 0 else str(action.metavar or action.dest.upper())
        lines += [".TP", f".B {roff(f'{names} {value}'.strip())}", roff(action.help or "")]
    return lines


def driver_page() -> str:
    """Return the manual page of ``sioms driver``."""
    actions = driver_actions()
    synopsis = [
        f"{name} {parser.format_usage().partition(name)[2].strip()}".strip() for name, (_, parser) in actions.items()
    ]
    body = [
        line for name, (text, parser) in actions.items() for line in (f".SS {name}", roff(text), *_arguments(parser))
    ]
    status = (
        "0 when nothing failed, 1 when a trial or a replay failed, 2 for what cannot be done, with one line on "
        "standard error."
    )
    return _page(
        "sioms-driver", 1, "list, check, record and replay drivers", [" ".join(usage.split()) for usage in synopsis],
        [
            ("description", _paragraphs([driver.ABOUT])),
            ("actions", body),
            ("exit status", [roff(status)]),
            ("see also", _see_also("sioms-driver")),
        ],
    ).replace(".B sioms-driver\n", ".B sioms driver\n")  # fmt: skip


def daemon_page() -> str:
    """Return the manual page of ``siomsd``."""
    text = [
        "siomsd reads a configuration, starts a driver process for each device, and exposes the devices as nodes of "
        "class axis, analog and binary on a Unix socket.",
        "SIGHUP takes up added, removed and changed devices without touching the others, as `sioms reload` does. "
        "SIGTERM and SIGINT stop all motion and end it.",
    ]
    return _page(
        "siomsd",
        8,
        "device daemon of a workcell",
        ["--config FILE [OPTION]..."],
        [
            ("description", _paragraphs(text)),
            ("options", _options(DAEMON_OPTIONS)),
            (
                "exit status",
                [roff("0 after an ordinary end; 1 when it cannot listen; 2 when the configuration is wrong.")],
            ),
            ("environment", [roff(VARIABLES)]),
            ("see also", _see_also("siomsd")),
        ],
    )


# --- completions ---------------------------------------------------------------------------------


def _words(tool: str) -> str:
    options = [o for _, group in option_groups(tool) for o in group]
    letters = [f"-{o.letter}" for o in options if o.letter]
    return " ".join([*letters, *[f"--{o.long}{'=' if o.value else ''}" for o in options]])


def bash() -> str:
    """Return the completion for bash."""
    lines = [
        "# Completion for bash; node names come from the running daemon. Generated by sioms.tools.generate.",
        "_sioms_nodes() { sioms list --names 2>/dev/null; }",
        "_sioms_tool() {",
        '    local word=${COMP_WORDS[COMP_CWORD]} options=""',
        "    case $1 in",
        *[f"    {tool}) options='{_words(tool)}' ;;" for tool in TOOLS],
        "    esac",
        "    if [[ $word == -* ]]; then",
        '        mapfile -t COMPREPLY < <(compgen -W "$options" -- "$word")',
        "        [[ ${COMPREPLY[0]} == *= ]] && compopt -o nospace",
        "    elif [[ $1 != smarkers ]]; then",
        '        mapfile -t COMPREPLY < <(compgen -W "$(_sioms_nodes)" -- "$word")',
        "    fi",
        "}",
        "_sioms_driver() {",
        '    local word=${COMP_WORDS[COMP_CWORD]} options=""',
        "    if ((COMP_CWORD == 2)); then",
        f"        mapfile -t COMPREPLY < <(compgen -W '{' '.join(driver_actions())}' -- \"$word\")",
        "        return",
        "    fi",
        "    case ${COMP_WORDS[2]} in",
        *[f"    {name}) options='{_long_options(parser)}' ;;" for name, (_, parser) in driver_actions().items()],
        "    esac",
        '    if [[ $word == -* ]]; then mapfile -t COMPREPLY < <(compgen -W "$options" -- "$word")',
        '    else mapfile -t COMPREPLY < <(compgen -f -- "$word"); fi',
        "}",
        "_sioms() {",
        "    local word=${COMP_WORDS[COMP_CWORD]}",
        "    if ((COMP_CWORD == 1)); then",
        f"        mapfile -t COMPREPLY < <(compgen -W '{' '.join(COMMANDS)} --help --version' -- \"$word\")",
        "        return",
        "    fi",
        "    case ${COMP_WORDS[1]} in",
        f'    {" | ".join(_NODE_COMMANDS)}) mapfile -t COMPREPLY < <(compgen -W "$(_sioms_nodes)" -- "$word") ;;',
        "    alarms) if ((COMP_CWORD == 2)); then mapfile -t COMPREPLY < <(compgen -W 'ack --json' -- \"$word\")",
        '        else mapfile -t COMPREPLY < <(compgen -W "$(_sioms_nodes) --all --message" -- "$word"); fi ;;',
        "    driver) _sioms_driver ;;",
        '    *) mapfile -t COMPREPLY < <(compgen -f -- "$word") ;;',
        "    esac",
        "}",
        f"complete -F _sioms_tool {' '.join(TOOLS)}",
        "complete -F _sioms sioms",
    ]
    return "\n".join([*lines, ""])


def _long_options(parser: argparse.ArgumentParser) -> str:
    return " ".join(word for action in parser._actions for word in action.option_strings if word.startswith("--"))


def _quoted(text: str) -> str:
    return text.replace("'", "'\\''").replace("[", "(").replace("]", ")").replace(":", ";")


def zsh() -> str:
    """Return the completion for zsh."""
    lines = [
        f"#compdef {' '.join(TOOLS)} sioms",
        "# Completion for zsh; node names come from the running daemon. Generated by sioms.tools.generate.",
        '_sioms_nodes() { local -a nodes; nodes=(${(f)"$(sioms list --names 2>/dev/null)"}); compadd -a nodes }',
        "case $service in",
    ]
    for tool in TOOLS:
        lines.append(f"{tool})")
        lines.append("    _arguments \\")
        for _, group in option_groups(tool):
            for o in group:
                glue = "=-" if o.value else ""
                value = f":{o.value}:" if o.value else ""
                lines.append(f"        '*--{o.long}{glue}[{_quoted(o.text)}]{value}' \\")
                if o.letter:
                    lines.append(f"        '*-{o.letter}{'-' if o.value else ''}[{_quoted(o.text)}]{value}' \\")
        lines.append("        '*:marker:'" if tool == "smarkers" else "        '*:node:_sioms_nodes'")
        lines.append("    ;;")
    lines += ["sioms)", "    if ((CURRENT == 2)); then", "        local -a commands", "        commands=("]
    lines += [f"            '{name}:{_quoted(c.text)}'" for name, c in COMMANDS.items()]
    lines += [
        "        )",
        "        _describe command commands",
        "    else",
        "        case $words[2] in",
        f"        {'|'.join(_NODE_COMMANDS)}) _sioms_nodes ;;",
        "        alarms) ((CURRENT == 3)) && compadd ack || _sioms_nodes ;;",
        f"        driver) ((CURRENT == 3)) && compadd {' '.join(driver_actions())} || _files ;;",
        "        *) _files ;;",
        "        esac",
        "    fi",
        "    ;;",
        "esac",
        "",
    ]
    return "\n".join(lines)


def fish() -> str:
    """Return the completion for fish."""
    lines = ["# Completion for fish; node names come from the running daemon. Generated by sioms.tools.generate."]
    for tool in TOOLS:
        nodes = "" if tool == "smarkers" else " -a '(sioms list --names 2>/dev/null)'"
        lines.append(f"complete -c {tool} -f{nodes}")
        for _, group in option_groups(tool):
            for o in group:
                short = f" -s {o.letter}" if o.letter else ""
                lines.append(f"complete -c {tool}{short} -l {o.long}{' -x' if o.value else ''} -d '{_quoted(o.text)}'")
    lines.append("complete -c sioms -n __fish_use_subcommand -f")
    for name, command in COMMANDS.items():
        lines.append(f"complete -c sioms -n __fish_use_subcommand -a {name} -d '{_quoted(command.text)}'")
    lines.append(
        f"complete -c sioms -n '__fish_seen_subcommand_from {' '.join(_NODE_COMMANDS)}' -f -a '(sioms list --names "
        "2>/dev/null)'"
    )
    lines.append("complete -c sioms -n '__fish_seen_subcommand_from alarms' -f -a ack")
    lines.append("complete -c sioms -n '__fish_seen_subcommand_from ack' -f -a '(sioms list --names 2>/dev/null)'")
    lines.append(
        "complete -c sioms -n 'test (count (commandline -opc)) -eq 2; and __fish_seen_subcommand_from driver' "
        f"-f -a '{' '.join(driver_actions())}'"
    )
    for name, (_, parser) in driver_actions().items():
        for option in _long_options(parser).split():
            lines.append(
                f"complete -c sioms -n '__fish_seen_subcommand_from driver; and __fish_seen_subcommand_from {name}' -l "
                f"{option[2:]}"
            )
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.exit(main())
