"""The picture of ``sioms monitor``: what was seen in, lines of text out. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo

KEYS = "space, e: EMERGENCY STOP   R: reset   q: quit   up, down: scroll"
_COMPACT = 110
"""Width below which an axis is shown with fewer columns, so that its flags stay on the screen."""


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
    """

    name: str
    device: str
    info: NodeInfo | None
    snapshot: Any
    why: str
    holder: str
    rate_hz: float | None


@dataclass(frozen=True, slots=True)
class View:
    """Everything that is shown.

    Attributes:
        status: the daemon's status, {} when there is none.
        nodes: in the order of the workcell.
        lost: why there is no daemon, '' when there is one.
        message: answer to the last key.
        now_ns: [ns, CLOCK_MONOTONIC].
    """

    status: dict[str, Any]
    nodes: Sequence[NodeView]
    lost: str
    message: str
    now_ns: int


def screen(view: View, width: int, height: int, scroll: int) -> tuple[list[Text], int]:
    """Lay the view out for a screen.

    Args:
        view: what is to be shown.
        width, height: of the screen [characters].
        scroll: lines of the body above the screen.

    Returns:
        Exactly ``height`` lines of at most ``width`` characters, and the scroll that was possible.
    """
    top, middle, bottom = head(view), body(view, width), [Text(KEYS, Style.DIM)]
    if view.message:
        bottom.insert(0, Text(view.message, Style.WARN))
    room = max(0, height - len(top) - len(bottom))
    scroll = max(0, min(scroll, len(middle) - room))
    shown = middle[scroll : scroll + room]
    shown += [Text("")] * (room - len(shown))
    if room and len(middle) > room:
        more = f"   (lines {scroll + 1} to {min(scroll + room, len(middle))} of {len(middle)})"
        bottom[-1] = Text(KEYS + more, Style.DIM)
    # A small screen keeps the top, where the stop stands, and the keys.
    lines = [*top, *shown, *bottom]
    if len(lines) > height:
        lines = [*top[: max(0, height - 1)], bottom[-1]][:height]
    return [Text(line.text[:width], line.style) for line in lines], scroll


def page(view: View, width: int) -> list[str]:
    """Return everything as lines for a printer or a pipe."""
    return [line.text.rstrip() for line in [*head(view), *body(view, width)]]


def head(view: View) -> list[Text]:
    """Return the workcell's line, and what is wrong with it as a whole."""
    if view.lost:
        return [Text(f"NO DAEMON: {view.lost}", Style.ALARM), Text("")]
    status = view.status
    if not status:
        return [Text("connecting", Style.WARN), Text("")]
    devices = status["devices"]
    up = sum(d["state"] == "up" for d in devices)
    lines = [
        Text(f"workcell {status['workcell']}   daemon {status['pid']}   devices {up} of {len(devices)} up   "
             f"sessions {len(status['sessions'])}", Style.HEAD)
    ]  # fmt: skip
    if status["stopped_ns"]:
        since = (view.now_ns - status["stopped_ns"]) / 1e9
        lines.append(Text(f" EMERGENCY STOP for {since:.1f} s: {status['stop_source']} ", Style.ALARM))
    for device in devices:
        if device["state"] != "up" or device["link"] != "good":
            why = device["reason"] or device["link_reason"]
            text = f"device {device['name']}: {device['state']}, link {device['link']}, {device['deaths']} deaths: {why}"
            lines.append(Text(text.removesuffix(": "), Style.WARN))
    return [*lines, Text("")]


def body(view: View, width: int) -> list[Text]:
    """Return the nodes, each with a line of its own and one for each of its axes, or a grid of values."""
    lines: list[Text] = []
    for node in view.nodes:
        if view.lost and node.snapshot is None:
            continue  # the head says why
        rate = "" if node.rate_hz is None else f"  {node.rate_hz:.0f}/s"
        holder = f"  held by {node.holder}" if node.holder else ""
        kind = node.info.node_class.name.lower() if node.info else ""
        lines.append(Text(f"{node.name}  {kind}{rate}{holder}", Style.HEAD))
        if node.info is None or node.snapshot is None:
            lines.append(Text(f"  {node.why or 'nothing read yet'}", Style.WARN))
        elif node.info.node_class is NodeClass.AXIS:
            lines += [
                _axis(c, reading, width) for c, reading in zip(node.info.channels, node.snapshot, strict=True)
            ]
        elif node.info.node_class is NodeClass.ANALOG:
            lines += _grid(
                [_analog(c, r) for c, r in zip(node.info.channels, node.snapshot, strict=True)], width
            )
        else:
            lines += [
                _binary(c, reading) for c, reading in zip(node.info.channels, node.snapshot, strict=True)
            ]
    return lines


_SERIOUS = AxisStatus.FAULT | AxisStatus.FOLLOWING_ERROR | AxisStatus.EMERGENCY_STOP | AxisStatus.STALLED


def _axis(channel: ChannelInfo, reading: Any, width: int) -> Text:
    status = AxisStatus(reading.status)
    style = Style.WARN if status & _SERIOUS else Style.GOOD if reading.in_motion else Style.PLAIN
    flags = ", ".join(words(status)) or "idle"
    unit, push = channel.unit or "", "N m" if channel.unit == "rad" else "N"
    if width < _COMPACT:
        text = f"  {channel.name:<7}{reading.position:>10.5f} {reading.velocity:>8.4f} {reading.force:>8.2f} {push:<3} {flags}"
        return Text(text, style)
    text = (
        f"  {channel.name:<10} {reading.position:>11.6f} {unit:<3} {reading.velocity:>10.5f} {unit + '/s':<5} "
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
