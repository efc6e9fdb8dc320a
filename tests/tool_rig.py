"""Rig for tests of the tools: snapshots and node information made by hand, out of the real classes; all parsers."""

from __future__ import annotations

import argparse
import struct
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from sioms.client.snapshot import SNAPSHOT, Layout
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.protocol.records import READ
from sioms.tools.front import installed

AXES = ("xaxis", "yaxis", "zaxis", "taxis")


def node_info(
    node_class: NodeClass, names: Sequence[str], *, name: str = "mod0", unit: str = "m", width: int = 0
) -> NodeInfo:
    """Return the information of a node with these channels."""
    channels = [ChannelInfo(each, unit, -1.0, 1.0, width, 0x3F, {"velocity": 0.5}).pack() for each in names]
    return NodeInfo([name, int(node_class), False, channels, -1, 1000.0, 64, "mod0", "sim-axes", 1])


def snapshot(node_class: NodeClass, count: int, **fields: Sequence[float]) -> Any:
    """Return a snapshot of all channels; fields that are not given are 0."""
    raw = struct.pack("<QQQQ", 7, 1_000_000_000, 42, 0)
    for name, column in READ[node_class].items():
        raw += struct.pack(f"<{count}{column.code}", *fields.get(name, [0] * count))
    return SNAPSHOT[node_class](raw, Layout(node_class, count, list(range(count)), -1))


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of all commands and actions by their words."""
    found: dict[str, argparse.ArgumentParser] = {}

    def walk(parser: argparse.ArgumentParser, words: str) -> None:
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for name, inner in action.choices.items():
                    found[f"{words} {name}".strip()] = inner
                    walk(inner, f"{words} {name}".strip())

    for module in {command.module for command in installed().values()}:
        parser = argparse.ArgumentParser()
        import_module(module).add_parser(parser.add_subparsers())
        walk(parser, "")
    return found
