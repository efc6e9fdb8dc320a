"""smarkers: reserve, free, signal and wait for markers (dissertation, section F.4.4).

A reservation prints one token a line, number and key in one integer, and outlives the program.
Decisions where the text leaves a choice are in docs/pipe-tools.md.
"""

from __future__ import annotations

from time import monotonic

from sioms.client.workcell import Workcell

from .options import FLAG, NAME, UsageError, scan
from .pipe import run, write_all

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_MOST = (1 << 50) - 1


def main(words: Sequence[str] | None = None) -> int:
    """Run smarkers; return the exit status."""
    return run("smarkers", _work, words)


def _work(words: Sequence[str]) -> None:
    actions, numbers, timeout_s = _read(words)
    if timeout_s is not None and "w" not in actions:
        raise UsageError("-t needs -w")
    if actions == ["r"]:
        if len(numbers) > 1:
            raise UsageError(f"-r takes one number, how many markers; {len(numbers)} are given")
        count = numbers[0] if numbers else 1
        markers = Workcell(name="smarkers").reserve_markers(count, persist=True)
        write_all("".join([f"{marker.token}\n" for marker in markers]).encode())
        return
    if not actions or "r" in actions:
        raise UsageError("want -r alone, or -f, -s, -w with markers; try --help")
    if not numbers:
        raise UsageError(f"-{actions[0]}: no marker given")
    cell = Workcell(name="smarkers")
    deadline = None if timeout_s is None else monotonic() + timeout_s
    left = timeout_s  # of the first wait it is all, as the user has given it
    act: dict[str, Callable[[int], object]] = {
        "f": cell.free_marker,
        "s": cell.signal_marker,
        "w": lambda token: cell.wait_marker(token, left),
    }
    for action in actions:
        for token in numbers:
            act[action](token)
            if deadline is not None:
                left = max(0.0, round(deadline - monotonic(), 3))


def _read(words: Sequence[str]) -> tuple[list[str], list[int], float | None]:
    actions: list[str] = []
    numbers: list[int] = []
    timeout_s: float | None = None
    for item in scan("smarkers", words):
        if item.kind == FLAG and item.text == "t":
            timeout_s = item.value
        elif item.kind == FLAG:
            actions.append(item.text)
        elif item.kind == NAME or not item.text.isascii() or not item.text.isdigit() or int(item.text) > _MOST:
            raise UsageError(f"{item.text}: want a marker: an integer as printed by smarkers -r")
        else:
            numbers.append(int(item.text))
    return actions, numbers, timeout_s
