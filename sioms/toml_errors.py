"""What is wrong with a TOML document and what would be right: the parser of the standard library tells little more than
where it stopped. Pure; used with errors only.
"""

from __future__ import annotations

import re
import tomllib

from sioms.protocol.text import printable

_AT = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_LONGEST = 80
"""Characters of the line that are shown."""
_COMMA = re.compile(r"[^=#]*=\s*([+-]?\d+),(\d+)\s*(?:#.*)?")
_BEGINS = re.compile(r"[=\[{,]\s*(?=[^=\[{,]*$)")
_ENDS = re.compile(r"[,\]}#]|$")
_HINTS = (
    (r"([+-]?)(\.\d[\d_]*(?:[eE][+-]?\d+)?)", "a number needs a digit before its point; want {1}0{2}"),
    (r"([+-]?\d+)\.(?:[eE].*)?", "a number needs a digit behind its point; want {1}.0"),
    (r"([+-]?)0+(\d[\d.]*)", "a number begins with no zero; want {1}{2}"),
    (r"(?i:true|false|yes|no|on|off)", "want true or false, in lower case and without quotes"),
    (r"([+-]?[\d.]+)\s*(?:[A-Za-z%°µ][\w/^*]*|/.*)", "want the number alone, in the unit that the key's page tells"),
    (r"[\u201c\u201d\u2018\u2019\u00ab\u00bb].*", 'want straight quotes: "..."'),
    (r"([A-Za-z~/.][^\s\"']*)", 'a text stands in quotes; want "{1}"'),
)
_WORDS = (
    ("Expected '=' after a key", "want KEY = VALUE, the key of letters, digits, _ and -, without blanks"),
    ("Expected ']'", "a table's line begins with [ and ends with ]"),
    ("Unclosed inline table", "what is between { and } stands on one line"),
    ("Invalid initial character for a key", "want a key; what is between { and } stands on one line"),
    ("Unclosed array", "want ] at the end of what [ begins"),
    ("Unterminated string", "want the quotes closed"),
    ('Expected "\'"', "want the quotes closed"),
    ("Unescaped '\\'", "a backslash is written twice in \"...\", once in '...'"),
    ("Cannot overwrite a value", "the key stands twice in its table; want it once"),
    ("Cannot declare", "the table stands twice; want it once, or [[...]] for several"),
    ("Expected newline", "want one KEY = VALUE a line"),
    ("Invalid statement", "want KEY = VALUE or [TABLE]"),
)


def explained(text: str, error: tomllib.TOMLDecodeError) -> str:
    """Return the error as a sentence: line, what stands there, and what would be right.

    Example:
        >>> try:
        ...     tomllib.loads("a = 1\\nlow = .035")
        ... except tomllib.TOMLDecodeError as error:
        ...     print(explained("a = 1\\nlow = .035", error))
        line 2: low = .035: a number needs a digit before its point; want 0.035
    """
    said = str(error)
    at = _AT.search(said)
    if at is None:
        return said
    lines = text.split("\n")
    number = int(at[1]) if at[1] else max(1, len(text.rstrip("\n").split("\n")))
    line = lines[number - 1] if number <= len(lines) else ""
    column = int(at[2]) - 1 if at[2] else len(line)
    shown = printable(line.strip(), _LONGEST)
    return f"line {number}: {shown}: {_wrong(said[: at.start()], line, column)}"


def _wrong(what: str, line: str, column: int) -> str:
    told = what[0].lower() + what[1:]
    if what.startswith(("Invalid value", "Expected newline")) and (known := _value(line, column)):
        return known
    return next((f"{told}; {hint}" for begin, hint in _WORDS if what.startswith(begin)), told)


def _value(line: str, column: int) -> str:
    """Return what is wrong with the value at a column, '' when it is nothing of the usual."""
    comma = _COMMA.fullmatch(line)
    if comma is not None:
        return f"a decimal comma; want {comma[1]}.{comma[2]}"
    begin = _BEGINS.search(line[:column])
    if begin is None:
        return ""
    end = _ENDS.search(line, begin.end())
    value = line[begin.end() : end.start() if end else None].strip()
    if not value and line[begin.start()] == "[":
        return "want ] at the end of what [ begins"
    if not value:
        return "no value; want one behind each = and between commas"
    fits = ((re.fullmatch(pattern, value), hint) for pattern, hint in _HINTS)
    return next((hint.format(value, *found.groups()) for found, hint in fits if found is not None), "")
