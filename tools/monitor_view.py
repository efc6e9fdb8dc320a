"""The picture of ``sioms monitor``: what was seen in, lines of text out. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from textwrap import wrap
from typing import Any

from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass, Severity
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo

from .alarms import acknowledged, ordered, word

KEYS = "space, e: EMERGENCY STOP  R: reset  tab, c: jog  h: history  arrows  q: quit"
JOG_KEYS = "space, e: EMERGENCY STOP  left, right: jog  < >: step  + -: speed  c: let go"
_COMPACT = 110
"""Width below which an axis is shown with fewer columns, so that its flags stay on the screen."""
_BODY_LEAST = 3
"""Lines of the nodes that a long list of faults leaves."""


class Style(Enum):
    """How a line is shown."""

    PLAIN = "plain"
    HEAD = "head"
    DIM = "dim"
    GOOD = "good"
    WARN = "warn"
    ALARM = "alarm"


@dataclass(frozen=True, slots=True)
class Text:
    """A line and its style."""

    text: str
    style: Style = Style.PLAIN


@dataclass(frozen=True, slots=True)
class NodeView:
    """One node as it was seen.

    Attributes:
        name, device: what and whose.
        info: None while it cannot be opened.
        snapshot: its newest reading, None when there is none.
        why: why there is none, a sentence.
        holder: who owns it, '' when it is free.
        rate_hz: publications a second, None before there are two looks.
        age_s: how long ago the snapshot was the newest [s], of a node that cannot be read any more; None: it is
            current.
    """

    name: str
    device: str
    info: NodeInfo | None
    snapshot: Any
    why: str
    holder: str
    rate_hz: float | None
    age_s: float | None = None


@dataclass(frozen=True, slots=True)
class Jog:
    """The axis that is chosen for jogging.

    Attributes:
        node, axis: which: name of the node, index of the axis in it.
        speed: of a jog [unit/s].
        step: of a step [unit].
        held: whether the monitor owns the axis, so that the keys move it.
    """

    node: str
    axis: int
    speed: float
    step: float
    held: bool


@dataclass(frozen=True, slots=True)
class View:
    """Everything that is shown.

    Attributes:
        status: the daemon's status, {} when there is none.
        nodes: in the order of the workcell.
        lost: why there is no daemon, '' when there is one.
        message: answer to the last key.
        now_ns: [ns, CLOCK_MONOTONIC].
        clock: time of day, shown so that a picture that stands still can be told.
        events: what has happened, as lines, oldest first.
        history: whether the events are shown instead of the nodes.
        jog: the axis that is chosen, if one is.
        alarms: as the daemon lists them.
    """

    status: dict[str, Any]
    nodes: Sequence[NodeView]
    lost: str
    message: str
    now_ns: int
    clock: str = ""
    events: Sequence[str] = ()
    history: bool = False
    jog: Jog | None = None
    alarms: Sequence[dict[str, Any]] = ()


def screen(view: View, width: int, height: int, scroll: int) -> tuple[list[Text], int]:
    """Lay the view out for a screen.

    Args:
        view: what is to be shown.
        width, height: of the screen [characters].
        scroll: lines of the body above the screen.

    Returns:
        Exactly ``height`` lines of at most ``width`` characters, and the scroll that was possible.
    """
    keys = JOG_KEYS if view.jog is not None and view.jog.held else KEYS
    middle = [Text(line) for line in view.events] if view.history else body(view, width)
    bottom = [Text(keys, Style.DIM)]
    if view.jog is not None:
        bottom.insert(0, _jog(view, view.jog))
    if view.message:
        bottom.insert(0, Text(view.message, Style.WARN))
    elif view.events and not view.history:
        bottom.insert(0, Text(f"last: {view.events[-1]}", Style.DIM))
    top = head(view, width, max(1, height - len(bottom) - _BODY_LEAST))
    room = max(0, height - len(top) - len(bottom))
    scroll = max(0, min(scroll, len(middle) - room))
    shown = middle[scroll : scroll + room]
    shown += [Text("")] * (room - len(shown))
    if room and len(middle) > room:
        top[-1] = Text(
            f"lines {scroll + 1} to {min(scroll + room, len(middle))} of {len(middle)}".rjust(width),
            Style.DIM,
        )
    # A small screen keeps the top, where the stop and the faults stand, and the keys.
    lines = [*top, *shown, *bottom]
    if len(lines) > height:
        lines = [*top[: max(0, height - 1)], bottom[-1]][:height]
    return [Text(line.text[:width], line.style) for line in lines], scroll


def _jog(view: View, jog: Jog) -> Text:
    """Return the line of the chosen axis."""
    node = next((node for node in view.nodes if node.name == jog.node and node.info is not None), None)
    if node is None or node.info is None:
        return Text(f"{jog.node} cannot be jogged: it is not available", Style.WARN)
    channel = node.info.channels[jog.axis]
    size = f"{jog.speed:g} {channel.unit}/s, steps of {jog.step:g} {channel.unit}"
    if jog.held:
        return Text(f"JOG {jog.node} {channel.name}: {size}", Style.GOOD)
    return Text(f"chosen: {jog.node} {channel.name} ({size}); c takes it, tab: the next axis", Style.DIM)


def page(view: View, width: int) -> list[str]:
    """Return everything as lines for a printer or a pipe."""
    return [line.text.rstrip() for line in [*head(view, width), *body(view, width)]]


def head(view: View, width: int = 120, height: int = 1000) -> list[Text]:
    """Return the workcell's line and all that is wrong, wherever the body has been scrolled to.

    Args:
        view: what is to be shown.
        width: of the screen [characters].
        height: most lines; what does not fit is counted in the last.
    """
    clock = f"   {view.clock}" if view.clock else ""
    status = view.status
    lines: list[Text] = []
    if view.lost:
        lines += [Text(text, Style.ALARM) for text in wrap(f"NO DAEMON{clock}: {view.lost}", max(width, 20))]
    elif not status:
        lines.append(Text(f"connecting{clock}", Style.WARN))
    else:
        devices = status["devices"]
        up = sum(d["state"] == "up" for d in devices)
        sessions = len(status["sessions"])
        text = f"workcell {status['workcell']}{clock}   {up} of {len(devices)} devices up   "
        text += f"{sessions} session{'s' * (sessions != 1)}   daemon {status['pid']}"
        lines.append(Text(text, Style.HEAD))
        if status["stopped_ns"]:
            since = (view.now_ns - status["stopped_ns"]) / 1e9
            lines.append(Text(f" EMERGENCY STOP for {since:.1f} s: {status['stop_source']} ", Style.ALARM))
        for device in devices:
            if device["state"] != "up" or device["link"] != "good":
                why = device["reason"] or device["link_reason"]
                text = (
                    f"device {device['name']}: {device['state']}, link {device['link']}, {device['deaths']} deaths: "
                    f"{why}"
                )
                lines.append(Text(text.removesuffix(": "), Style.WARN))
    lines += alarm_lines(view.alarms)
    lines += [Text(text, Style.ALARM) for text in _wrapped([f"{who}: {what}" for who, what in faults(view)], width)]
    if len(lines) > height:
        hidden = len(lines) - height + 1
        lines = [
            *lines[: height - 1],
            Text(f"and {hidden} more lines of errors; enlarge the window to see them", Style.ALARM),
        ]
    return [*lines, Text("")]


def alarm_lines(alarms: Sequence[dict[str, Any]]) -> list[Text]:
    """Return the alarms, those first that want attention; present faults and losses stand beside them already."""
    lines = []
    for alarm in ordered(alarms):
        if alarm["severity"] and alarm["what"] in ("driver", "fault", "link"):
            continue
        is_urgent = alarm["state"] == "unacknowledged" and alarm["severity"] >= Severity.MAJOR
        text = f"{alarm['state']} {word(alarm['severity'] or alarm['worst'])} alarm of {alarm['node']} {alarm['what']}"
        lines.append(Text(f"{text}: {alarm['text']}{acknowledged(alarm)}", Style.ALARM if is_urgent else Style.WARN))
    return lines


def faults(view: View) -> list[tuple[str, str]]:
    """Return what is wrong with single channels: (node and channel, flags in words)."""
    found = []
    for node in view.nodes:
        if node.info is None or node.snapshot is None or node.age_s is not None:
            continue
        wrong: list[AxisStatus | AnalogStatus] = []
        if node.info.node_class is NodeClass.AXIS:
            wrong = [AxisStatus(int(status)) & _SERIOUS for status in node.snapshot.status]
        elif node.info.node_class is NodeClass.ANALOG:
            wrong = [AnalogStatus(int(flags)) for flags in node.snapshot.flags]
        found += [
            (name_of(node, channel), ", ".join(words(flags)))
            for channel, flags in zip(node.info.channels, wrong, strict=False)
            if flags
        ]
    return found


def name_of(node: NodeView, channel: ChannelInfo) -> str:
    """Return the name under which a channel is told."""
    single = node.info is not None and len(node.info.channels) == 1
    return node.name if single else f"{node.name}.{channel.name}"


def _wrapped(parts: Sequence[str], width: int) -> list[str]:
    """Return parts in lines of at most a width, as many in each as fit."""
    lines: list[str] = []
    for part in parts:
        if lines and len(lines[-1]) + 3 + len(part) <= width:
            lines[-1] += " | " + part
        else:
            lines.append(part)
    return lines


def body(view: View, width: int) -> list[Text]:
    """Return the nodes, each with a line of its own and one for each of its axes, or a grid of values."""
    lines: list[Text] = []
    for node in view.nodes:
        if view.lost and node.snapshot is None:
            continue  # the head says why
        first = len(lines)
        rate = "" if node.rate_hz is None else f"  {node.rate_hz:.0f}/s"
        holder = f"  held by {node.holder}" if node.holder else ""
        kind = node.info.node_class.name.lower() if node.info else ""
        old = "" if node.age_s is None else f"  LAST SEEN {node.age_s:.1f} s AGO: {node.why}"
        lines.append(Text(f"{node.name}  {kind}{rate}{holder}{old}", Style.WARN if old else Style.HEAD))
        if node.info is None or node.snapshot is None:
            lines.append(Text(f"  {node.why or 'nothing read yet'}", Style.WARN))
        elif node.info.node_class is NodeClass.AXIS:
            chosen = view.jog.axis if view.jog is not None and view.jog.node == node.name else -1
            lines += [
                _axis(c, reading, width, i == chosen)
                for i, (c, reading) in enumerate(zip(node.info.channels, node.snapshot, strict=True))
            ]
        elif node.info.node_class is NodeClass.ANALOG:
            lines += _grid([_analog(c, r) for c, r in zip(node.info.channels, node.snapshot, strict=True)], width)
        else:
            lines += [_binary(c, reading) for c, reading in zip(node.info.channels, node.snapshot, strict=True)]
        if node.age_s is not None:
            lines[first + 1 :] = [Text(line.text, Style.DIM) for line in lines[first + 1 :]]
    return lines


_SERIOUS = AxisStatus.FAULT | AxisStatus.FOLLOWING_ERROR | AxisStatus.EMERGENCY_STOP | AxisStatus.STALLED


def _axis(channel: ChannelInfo, reading: Any, width: int, chosen: bool) -> Text:
    status = AxisStatus(reading.status)
    style = Style.WARN if status & _SERIOUS else Style.GOOD if reading.in_motion else Style.PLAIN
    flags = ", ".join(words(status)) or "idle"
    unit, push = channel.unit or "", "N m" if channel.unit == "rad" else "N"
    mark = "> " if chosen else "  "
    if width < _COMPACT:
        text = (
            f"{mark}{channel.name:<7}{reading.position:>10.5f} {unit:<3} {reading.velocity:>8.4f} {unit + '/s':<5} "
            f"{reading.force:>8.2f} {push:<3} {flags}"
        )
        return Text(text, style)
    text = (
        f"{mark}{channel.name:<10} {reading.position:>11.6f} {unit:<3} {reading.velocity:>10.5f} {unit + '/s':<5} "
        f"{reading.force:>9.3f} {push:<3} error {reading.following_error:>9.2e}  buffer {reading.buffered:>5}  "
        f"{flags}"
    )
    return Text(text, style)


def _analog(channel: ChannelInfo, reading: Any) -> Text:
    wrong = words(AnalogStatus(reading.flags))
    text = f"{channel.name:<6} {reading.data:>11.4g} {channel.unit:<4}{' '.join(wrong)}"
    return Text(text, Style.WARN if wrong else Style.PLAIN)


def _binary(channel: ChannelInfo, reading: Any) -> Text:
    width = max(1, channel.width)
    return Text(f"  {channel.name:<10} {reading.data:>0{width}b}  = {reading.data}  {reading.edges} edges")


def _grid(cells: list[Text], width: int) -> list[Text]:
    """Lay cells side by side in as many columns as fit; a line is as serious as its worst cell."""
    if not cells:
        return []
    wide = max(len(cell.text) for cell in cells) + 2
    across = max(1, (width - 2) // wide)
    lines = []
    for first in range(0, len(cells), across):
        row = cells[first : first + across]
        style = Style.WARN if any(cell.style is Style.WARN for cell in row) else Style.PLAIN
        lines.append(Text("  " + "".join([cell.text.ljust(wide) for cell in row]).rstrip(), style))
    return lines


def words(flags: AxisStatus | AnalogStatus) -> list[str]:
    """Return the flags that are set, in words.

    Example:
        >>> words(AxisStatus.MOVING | AxisStatus.WAITING_MARKER)
        ['moving', 'waiting marker']
    """
    return [flag.name.lower().replace("_", " ") for flag in type(flags) if flag in flags and flag.name]
