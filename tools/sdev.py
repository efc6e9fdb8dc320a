"""sdev: send requests to devices (dissertation, section F.4.3).

Decisions where the text leaves a choice are in docs/pipe-tools.md.
"""

from __future__ import annotations

import errno

from sioms.client.stopping import emergency_stop

from .options import Line, Target, UsageError, fold, is_numeric
from .pipe import NO_NUMBER, READONLY, by_any_name, complain, open_node, read_input, run
from .tokens import Tokens

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from sioms.client.workcell import Workcell

_COMPANION = "sw"  # requests that need no ownership go through the read-only companion


def main(words: Sequence[str] | None = None) -> int:
    """Run sdev; return the exit status."""
    return run("sdev", _work, words)


def _read(words: Sequence[str]) -> tuple[Line, Tokens]:
    line = fold("sdev", words)
    numbers = Tokens()
    if line.numbers:
        numbers.feed((" ".join(line.numbers) + " ").encode())
    if numbers.bad:
        raise UsageError(numbers.bad.partition(": ")[2])
    _check(line)
    return line, numbers


def _work(words: Sequence[str]) -> None:
    try:
        line, numbers = _read(words)
    except UsageError as error:
        if not any(map(_asks_to_stop, words)):
            raise
        emergency_stop("sdev -e", name="sdev")
        raise UsageError(f"{error}; the whole workcell has been stopped") from None
    if not line.targets:
        if unheard := emergency_stop("sdev -e", name="sdev"):
            complain("sdev", f"stopped and latched by the drivers; {unheard}", 0)
        return
    from sioms.client.workcell import Workcell  # not before a stop of the workcell

    cell = Workcell(name="sdev")
    _stop(cell, line)
    if "t" in line.common and not any("w" in target.flags for target in line.targets):
        raise UsageError("-t needs -w")
    Setter(cell, numbers, bool(line.numbers), line.common.get("t")).carry_out(
        [Target(t.name, {key: 0 for key in t.flags if key != "e"}) for t in line.targets]
    )


def _asks_to_stop(word: str) -> bool:
    """Tell whether a word of a command line that cannot be read asks for an emergency stop."""
    return word == "--emergency-stop" or (word[:1] == "-" and word[1:2] != "-" and "e" in word and not is_numeric(word))


def _check(line: Line) -> None:
    if not line.targets and list(line.trailing) != ["e"]:
        raise UsageError("no device given; only -e works without one: it stops the whole workcell")
    if line.targets and line.trailing:
        raise UsageError(f"-{next(iter(line.trailing))} applies to the device that follows it, and none follows")
    for i, target in enumerate(line.targets):
        if not target.flags:
            word = f"; {NO_NUMBER}" if i else ""
            raise UsageError(f"{target.name}: nothing to do; an option applies to the device that follows it{word}")


def _stop(cell: Workcell, line: Line) -> None:
    """Carry out the emergency stops, which overtake everything else on the command line."""
    words = [target.name for target in line.targets if "e" in target.flags]
    if not words:
        return
    from sioms.client.undisturbed import Undisturbed

    with Undisturbed():  # an interrupt between two attempts would leave it at none
        for word in words:
            try:
                by_any_name(
                    word, lambda name: cell.emergency_stop(name.removesuffix(READONLY), "sdev -e", or_all=False)
                )
            except FileNotFoundError:  # by none of its names
                cell.emergency_stop(word, "sdev -e")


class Setter:
    """Carries out the requests of a command line, device by device, letter by letter.

    Args:
        cell: the connection.
        numbers: those of the command line; more are read from standard input when they are needed.
        given: whether there were any on the command line: then none may be left over.
        timeout_s: how long -w waits [s]; None: for ever.
    """

    def __init__(self, cell: Workcell, numbers: Tokens, given: bool, timeout_s: float | None = None) -> None:
        self._cell = cell
        self._numbers = numbers
        self._given = given
        self._timeout_s = timeout_s

    def carry_out(self, targets: list[Target]) -> None:
        """Open what is needed, check the numbers, then act.

        Raises:
            OSError: refused, or the numbers are not those needed; in the latter case nothing was done.
            UsageError: a request that the class of the device does not know.
        """
        nodes = [self._open(target) for target in targets if target.flags]
        plan = [(node, key, self._take(node, key)) for node, target in nodes for key in target.flags]
        if self._given and self._numbers.numbers:
            left = len(self._numbers.numbers)
            raise UsageError(f"{left} number{'s' * (left > 1)} too many; -c takes one per axis, -g n*n")
        synched = [node for node, key, _ in plan if key == "s"]
        for node, key, numbers in plan:
            if key != "s":
                self._act(node, key, numbers)
            elif synched:
                self._cell.synch(*synched)
                synched = []
        for node, _ in nodes:
            node.close()

    def _open(self, target: Target) -> tuple[Any, Target]:
        companion = all(key in _COMPANION for key in target.flags)
        # Mode 'r' is enough: a node that can be written is exclusive in whatever mode.
        return open_node(self._cell, target.name, "r", companion=companion), target

    def _take(self, node: Any, key: str) -> list[float]:
        """Take the numbers that a request needs."""
        node_class = node.info.node_class
        from sioms.protocol.flags import NodeClass

        wanted = NodeClass.ANALOG if key == "g" else NodeClass.AXIS
        if key != "z" and node_class is not wanted:
            raise UsageError(
                f"-{key} on {node.name}: applies to nodes of class {wanted.name.lower()}; this one is "
                f"{node_class.name.lower()}"
            )
        count = len(node.info.channels)
        need = {"c": count, "g": count * count}.get(key, 0)
        tokens = self._numbers
        while len(tokens.numbers) < need and not tokens.bad:
            data = read_input()
            tokens.feed(data)
            if not data:
                break
        if len(tokens.numbers) < need:
            why = tokens.bad or f"there are {len(tokens.numbers)}"
            raise OSError(errno.EINVAL, f"-{key} on {node.name}: want {need} numbers: {why}")
        taken, tokens.numbers = tokens.numbers[:need], tokens.numbers[need:]
        return [value for value, _ in taken]

    def _act(self, node: Any, key: str, numbers: list[float]) -> None:
        match key:
            case "z":
                node.zero()
            case "w":
                node.wait_until_idle(self._timeout_s)
            case "c":
                node.calibrate(*numbers)
            case "g":
                node.set_gains(numbers)
