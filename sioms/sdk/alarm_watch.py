"""Alarms of channels, as ``[[alarm]]`` in the configuration gives them: limits, what is told of them, what they stop.

Every publication is looked at, so that no excursion is too short to be seen. Devices without alarms pay nothing.

Concurrency: owned by the one thread of the driver process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.driver_verbs import AlarmChanged
from sioms.protocol.flags import AnalogStatus, NodeClass, PageState, Reaction, Severity
from sioms.protocol.records import READ, read_rows
from sioms.protocol.verbs import Message

from .alarms import HIGH, HIHI, LIMITS, LOLO, LOW, Alarms
from .blocks import AnyBlock

INVALID = int(AnalogStatus.INVALID)
OFF_DELAY_NS = 100_000_000
"""How long an alarm must be less severe before that is told: what trembles at a limit is one alarm."""

_SEVERITY = np.zeros(HIHI * 2, dtype=np.int64)
"""Severity of the bits of limits."""
for _bits in range(1, HIHI * 2):
    if _bits & (LOLO | HIHI):
        _SEVERITY[_bits] = Severity.MAJOR
    elif _bits & (LOW | HIGH):
        _SEVERITY[_bits] = Severity.MINOR


class Rule(NamedTuple):
    """The alarm of one channel, or of one bit of it (-1: all): which column of its readings is watched, where its
    limits are [unit of the column], and what it stops at each severity.

    ``node`` is the node that the configuration names, ``stops`` are its channels.
    """

    block: int
    channel: int
    bit: int
    column: str
    lolo: float
    low: float
    high: float
    hihi: float
    hysteresis: float
    on_minor: Reaction
    on_major: Reaction
    on_invalid: Reaction
    node: str
    stops: Sequence[int]

    @property
    def limits(self) -> tuple[float, float, float, float, float]:
        """Its limits and the hysteresis, as ``Alarms.watch`` takes them."""
        return self.lolo, self.low, self.high, self.hihi, self.hysteresis

    @classmethod
    def of(cls, row: Sequence[Any]) -> Rule:
        """Make one of what the daemon has sent."""
        return cls(*row[:9], *[Reaction(each) for each in row[9:12]], *row[12:])


class Group:
    """The rules of one column of a block, and the severities that have been told.

    Args:
        block: whose readings.
        rules: of this block and column.

    Attributes:
        told: severity of each rule as the daemon knows it, -1: not yet.
    """

    def __init__(self, block: AnyBlock, rules: Sequence[Rule]) -> None:
        self.block, self.rules = block, rules
        self.told = np.full(len(rules), -1)
        self._channels = np.array([rule.channel for rule in rules], dtype=np.intp)
        self._bits = np.array([max(rule.bit, 0) for rule in rules])
        self._masks = np.array([1 if rule.bit >= 0 else -1 for rule in rules])
        self._since_ns = np.zeros(len(rules), dtype=np.int64)
        self._limits = Alarms(len(rules))
        for i, rule in enumerate(rules):
            self._limits.watch([i], *rule.limits)
        column = rules[0].column
        self._flags: NDArray[np.int64] | None = None
        if block.spec.node_class is NodeClass.ANALOG:
            self._row, self._flags = block.shown_data, block.shown_flags  # type: ignore[union-attr]
        else:
            fields = block.bank.fields if block.spec.node_class is NodeClass.AXIS else block.fields  # type: ignore[union-attr]
            self._row = read_rows(block.spec.node_class, fields)[column]
        self._is_binary = block.spec.node_class is NodeClass.BINARY

    def values(self) -> NDArray[np.float64]:
        """Return what is watched, as it was published last."""
        values = self._row[self._channels]
        if self._is_binary:
            values = values >> self._bits & self._masks
        return values.astype(np.float64)

    def look(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the severities at these values."""
        blind = np.isnan(values)
        if self._flags is None:
            severities = _SEVERITY[self._limits.look(values)]
        else:  # what is published of analog channels says already which limits are reached
            flags = self._flags[self._channels]
            severities = _SEVERITY[flags & LIMITS]
            blind |= flags & INVALID != 0
        severities[blind] = Severity.INVALID
        return severities

    def changed(self, severities: NDArray[np.int64], now_ns: int) -> Iterable[int]:
        """Return the rules of which there is something to tell, the first with ``told`` as it was; a severity that
        is less than the one that was told must hold for a while.
        """
        lower = severities < self.told
        if not lower.any():
            self._since_ns[:] = 0
            if (severities == self.told).all():
                return ()
        fresh = lower & (self._since_ns == 0)
        self._since_ns[fresh] = now_ns
        self._since_ns[~lower] = 0
        tell = (severities > self.told) | (lower & (now_ns - self._since_ns >= OFF_DELAY_NS))
        found: list[int] = np.flatnonzero(tell).tolist()
        return found

    def text(self, i: int, value: float, severity: int) -> str:
        """Return in words why a rule is at a severity."""
        rule, spec = self.rules[i], self.block.spec
        channel = spec.channels[rule.channel]
        force = "N*m" if channel.unit == "rad" else "N"
        unit = READ[spec.node_class][rule.column].unit.format(u=channel.unit, f=force)
        now = f"{rule.column.replace('_', ' ')} {value:g} {unit}".rstrip()
        if severity == Severity.INVALID:
            return f"{rule.column.replace('_', ' ')} cannot be read: it is no valid measurement"
        if self._is_binary:
            return f"it reads {value:g}"
        if severity == Severity.NONE:
            return f"{now} is within the limits again"
        low, high = (rule.lolo, rule.hihi) if severity == Severity.MAJOR else (rule.low, rule.high)
        return f"{now} has reached {high if value - low > high - value else low:g}".rstrip() + f" {unit}".rstrip()


class AlarmWatch:
    """Watches a device's channels.

    Args:
        blocks: of the device.
        rows: what ``Rule.of`` takes, for each of its alarms.
        tell: sends the daemon a message.
        react: stops what a reaction says: (reaction, block, rule, source).
    """

    def __init__(
        self, blocks: Sequence[AnyBlock], rows: Iterable[Sequence[Any]], tell: Callable[[Message], None],
        react: Callable[[Reaction, AnyBlock, Rule, str], None],
    ) -> None:  # fmt: skip
        columns: dict[tuple[int, str], list[Rule]] = {}
        for rule in map(Rule.of, rows):
            block = blocks[rule.block]
            if block.spec.node_class is NodeClass.ANALOG:
                block.alarms = block.alarms or Alarms(block.n)  # type: ignore[union-attr]
                block.alarms.watch([rule.channel], *rule.limits)  # type: ignore[union-attr]
            columns.setdefault((rule.block, rule.column), []).append(rule)
        self._groups: dict[int, list[Group]] = {}
        for (number, _), group in columns.items():
            self._groups.setdefault(id(blocks[number]), []).append(Group(blocks[number], group))
        self._tell, self._react = tell, react
        self._due: list[tuple[Reaction, AnyBlock, Rule, str]] = []

    def look(self, block: AnyBlock, now_ns: int) -> None:
        """Look at what has just been published; what it shall stop is stopped by ``react``."""
        for group in self._groups.get(id(block), ()):
            values = group.values()
            severities = group.look(values)
            for i in group.changed(severities, now_ns):
                self._take(group, i, int(severities[i]), group.text(i, float(values[i]), int(severities[i])))

    def lose(self, blocks: Iterable[AnyBlock], state: PageState, why: str) -> None:
        """Take what cannot be read any more for invalid, and stop what that shall stop."""
        if state in (PageState.GOOD, PageState.STARTING):
            return
        for block in blocks:
            for group in self._groups.get(id(block), ()):
                for i, told in enumerate(group.told.tolist()):
                    if told != Severity.INVALID:
                        self._take(group, i, Severity.INVALID, f"it cannot be read: {why}")
        self.react()

    def react(self) -> None:
        """Stop what alarms shall stop that have become more severe."""
        due, self._due = self._due, []
        for each in due:
            self._react(*each)

    def _take(self, group: Group, i: int, severity: int, text: str) -> None:
        rule, before = group.rules[i], int(group.told[i])
        group.told[i] = severity
        self._tell(AlarmChanged(rule.block, rule.channel, rule.bit, rule.column, severity, text, 0))
        if severity <= max(before, 0):
            return
        reaction = (Reaction.NONE, rule.on_minor, rule.on_major, rule.on_invalid)[severity]
        if reaction is not Reaction.NONE:
            self._due.append((reaction, group.block, rule, text))
