"""Text of a peer, a device or a file, made fit for logs, messages and terminals.

A character that moves the cursor, changes colours, breaks a line or hides others is shown as its escape, and what is
longer than asked for ends in an ellipsis. It is done where a text comes in or is packed, never where it is shown.
"""

from __future__ import annotations

MAX_TEXT = 1024
"""Characters of a text that goes into a message, at most."""


def printable(text: str, most: int = MAX_TEXT) -> str:
    r"""Return a text without control characters, of at most ``most`` characters.

    Example:
        >>> print(printable("eva\x1b[2J\r\n"))
        eva\x1b[2J\r\n
        >>> printable("x" * 100, 5)
        'xxxx…'
    """
    if len(text) > most:
        text = text[: most - 1] + "…"
    if text.isprintable():
        return text
    escaped = "".join([c if c.isprintable() else c.encode("unicode_escape").decode() for c in text])
    return escaped if len(escaped) <= most else escaped[: most - 1] + "…"


def shown(value: object, most: int = 80) -> str:
    """Return the repr of a decoded value, bounded; decoding has bounded its depth."""
    return printable(repr(value), most)
