"""Readings of a recording as tables of named columns with units, and as files that other programs read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.records import READ

from .messages import Event
from .reader import Recording, Table

_TITLES = {"commanded_position": "command", "data": ""}
"""Columns whose titles are others than their names: those of ``devin --record``."""


def head_of(info: NodeInfo, channel: int, column: str) -> str:
    """Return the head of a column, as ``xaxis position [m]``; the channel is left out where there is only one."""
    about = info.channels[channel]
    title = _TITLES.get(column, column)
    push = "N m" if about.unit == "rad" else "N"
    unit = READ[info.node_class][column].unit.format(u=about.unit, f=push) if about.unit else ""
    words = [about.name if len(info.channels) > 1 or not title else "", title]
    shown = " ".join([word for word in words if word])
    return f"{shown} [{unit}]" if unit else shown


def columns_of(
    recording: Recording, node: str, columns: list[str] | None = None, start_ns: int = 0, end_ns: int = 1 << 62
) -> dict[str, NDArray[Any]]:
    """Return the readings of a node by heads, "time [s]" first: stamps on the monotonic clock.

    Args:
        recording: where they are.
        node: its name.
        columns: of its class; None: all.
        start_ns, end_ns: from when until when [ns, CLOCK_MONOTONIC].
    """
    return of_table(recording.node(node).info, recording.table(node, columns, start_ns, end_ns))


def of_table(info: NodeInfo, table: Table) -> dict[str, NDArray[Any]]:
    """Return readings by heads; see ``columns_of``."""
    found: dict[str, NDArray[Any]] = {"time [s]": table.stamps_ns / 1e9, "number": table.numbers}
    for channel in range(len(info.channels)):
        for column, values in table.values.items():
            found[head_of(info, channel, column)] = values[:, channel]
    return found


def of_events(events: Sequence[Event]) -> dict[str, NDArray[Any]]:
    """Return what happened as a table: data as JSON, messages as they came in hexadecimal."""
    words = ("source", "kind", "node", "who", "error", "text")
    columns: dict[str, list[Any]] = {
        "time [s]": [event.stamp_ns / 1e9 for event in events],
        **{word: [getattr(event, word) for event in events] for word in words},
        "data": [json.dumps(event.data, default=str) if event.data else "" for event in events],
        "raw": [event.raw.hex() for event in events],
    }  # fmt: skip
    kinds = {"time [s]": np.float64, "error": np.int64}
    return {name: np.array(values, kinds.get(name, np.str_)) for name, values in columns.items()}


def main_column(info: NodeInfo) -> str:
    """Return the column that a plot shows, if none is asked for."""
    return "position" if info.node_class is NodeClass.AXIS else "data"


def of_one_node(path: Path, node_class: NodeClass) -> tuple[NodeInfo, dict[str, NDArray[Any]]]:
    """Return the node that a recording is about and its readings, none of them missing.

    Args:
        path: of the recording.
        node_class: whose node it is, if several are recorded: the only one of this class.

    Raises:
        OSError: it cannot be read.
        ValueError: it is about no or several such nodes, or readings are missing; the sentence says what helps.
    """
    with Recording(path) as recording:
        nodes = [node.info for node in recording.nodes.values()]
        chosen = [info for info in nodes if info.node_class is node_class] if len(nodes) > 1 else nodes
        if len(chosen) != 1:
            names = ", ".join(info.name for info in chosen or nodes) or "none"
            raise ValueError(
                f"read {path}: it holds the nodes {names}; want one {node_class.name.lower()} node: `sioms log cut "
                f"{path} NODE -o FILE` leaves one"
            )
        columns = columns_of(recording, chosen[0].name)
        if recording.damage:
            raise ValueError(f"read {path}: {recording.damage[0]}; `sioms log cut` takes what is whole before or after")
        gaps = np.flatnonzero(np.diff(columns["number"]) != 1)
        if len(gaps):
            at_s = columns["time [s]"][gaps[0]] - columns["time [s]"][0]
            raise ValueError(
                f"read {path}: snapshots of {chosen[0].name} are missing {at_s:.3f} s after the beginning; `sioms log "
                "cut --from, --to` takes what is whole"
            )
        del columns["number"]
        return chosen[0], columns
