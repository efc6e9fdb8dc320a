"""What the pipe tools share: how they begin and end, and how a word becomes an open node."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # signal without enum
import errno
import os
import sys

from .options import HelpWanted, UsageError

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any

    from sioms.client.workcell import Workcell

READONLY = ".readonly"


def run(tool: str, work: Callable[[Sequence[str]], None], words: Sequence[str] | None) -> int:
    """Run a tool as a filter: dies of SIGPIPE and SIGINT like any other, says one line when it fails.

    Returns:
        0; 1 after a failure; 2 when the command line was wrong.
    """
    as_program = words is None
    if words is None:
        # The interpreter's own handlers would turn both into tracebacks. A killed client's axes are halted
        # by their driver, so there is nothing to clean up that is not cleaned up by the end itself.
        _signal.signal(_signal.SIGINT, _signal.SIG_DFL)
        _signal.signal(_signal.SIGPIPE, _signal.SIG_DFL)
        words = sys.argv[1:]
        _occupy_standard_descriptors()
    status = _status(tool, work, words)
    if as_program:
        # Leave without taking the interpreter apart: everything is written, and the kernel closes the rest.
        if sys.stdout is not None:
            sys.stdout.flush()
        os._exit(status)
    return status


def _occupy_standard_descriptors() -> None:
    """See to it that no socket becomes standard input or output where the caller has closed them (``<&-``).

    Reading or writing there fails as it should.
    """
    for fd, mode in enumerate((os.O_WRONLY, os.O_RDONLY, os.O_RDWR)):
        try:
            os.fstat(fd)
        except OSError:
            os.open(os.devnull, mode)  # takes the lowest that is free


def _status(tool: str, work: Callable[[Sequence[str]], None], words: Sequence[str]) -> int:
    try:
        work(words)
    except HelpWanted as wanted:
        from .manual import answer

        return answer(tool, str(wanted))
    except UsageError as error:
        return complain(tool, str(error), 2)
    except OSError as error:
        return complain(tool, error.strerror or str(error), 1)
    return 0


def complain(tool: str, text: str, status: int) -> int:
    """Say one line on standard error; return the exit status."""
    line = f"{tool}: {' '.join(text.split())}\n"
    try:
        os.write(2, line.encode("utf-8", "replace"))
    except OSError:  # nobody listens there; the status still tells
        return status
    return status


def write_all(data: bytes) -> None:
    """Write to standard output and return when all is out; nothing is kept back in a buffer."""
    while data:
        try:
            data = data[os.write(1, data) :]
        except BlockingIOError:  # whoever gave us this descriptor has made it non-blocking
            from select import POLLOUT, poll

            poller = poll()
            poller.register(1, POLLOUT)
            poller.poll()
        except OSError as error:
            raise OSError(error.errno, f"write standard output: {os.strerror(error.errno or 0).lower()}") from None


def read_input() -> bytes:
    """Return what standard input has, waiting for it; b'' at its end."""
    try:
        return os.read(0, 65536)
    except OSError as error:
        raise OSError(error.errno, f"read standard input: {os.strerror(error.errno or 0).lower()}") from None


def base_name(word: str) -> str:
    """Return the node that a path means: the last part of it, behind all soft links.

    Example:
        >>> base_name("~rws/dev/mod0"), base_name("mod0.xaxis")
        ('mod0', 'mod0.xaxis')
    """
    return os.path.basename(os.path.realpath(word)) if "/" in word else word


def names_of(word: str) -> list[str]:
    """Return the names under which a word is looked up: itself, then what a soft link here points to."""
    name = base_name(word)
    if "/" not in word and os.path.islink(word):
        return [name, os.path.basename(os.path.realpath(word))]
    return [name]


NO_NUMBER = "nor is it a number, which begins with a digit, a sign or a point"
"""What is said of a word beside nodes and numbers that is neither."""


def open_node(
    cell: Workcell, word: str, mode: str, *, companion: bool = False, lease_s: float = 0.0, first: bool = True
) -> Any:
    """Open the node that a word names.

    Args:
        cell: the connection.
        word: node name, or a path or soft link that ends in one.
        mode: 'r' or 'rw'.
        companion: open its read-only companion where it has one, so that nobody is disturbed.
        lease_s: longest silence before its axes are halted [s]; 0: none.
        first: where it is not the first word of its command line, it may have been meant as a number.

    Raises:
        OSError: it cannot be opened; of several names tried the error of the first.
    """
    try:
        return by_any_name(word, lambda name: cell.open(name, mode, lease=lease_s), companion=companion)
    except OSError as error:
        if first or error.errno != errno.ENOENT:
            raise
        raise OSError(errno.ENOENT, f"{error.strerror}; {NO_NUMBER}") from None


def by_any_name(word: str, act: Callable[[str], Any], *, companion: bool = False) -> Any:
    """Do something with the first node that there is of those that a word may name.

    Raises:
        OSError: it cannot be done; when there is none of the names, what was said of the word itself.
    """
    names = names_of(word)
    missing: dict[str, OSError] = {}
    for name in names:
        for attempt in [name + READONLY, name] if companion and not name.endswith(READONLY) else [name]:
            try:
                return act(attempt)
            except OSError as error:
                if error.errno != errno.ENOENT:
                    raise
                missing[attempt] = error
    raise missing[names[0]]
