"""Arguments that every command with the hand of a running workcell has."""

from __future__ import annotations

import argparse

FINGERS = ("touch1.shape", "touch2.shape")


def add_hand(parser: argparse._ActionsContainer) -> None:
    """Add the nodes of the hand and of its fingers."""
    parser.add_argument("--node", default="hand", metavar="NAME", help="the hand's node (default hand)")
    add_fingers(parser)


def add_fingers(parser: argparse._ActionsContainer) -> None:
    """Add the nodes of the fingers."""
    parser.add_argument(
        "--fingers", nargs=2, default=list(FINGERS), metavar="NODE",
        help=f"estimate of each finger (default {' '.join(FINGERS)})",
    )  # fmt: skip


def add_beside(parser: argparse._ActionsContainer) -> None:
    """Add the nodes of the modules and of the wrists."""
    parser.add_argument(
        "--modules", nargs=2, default=["left", "right"], metavar="NODE",
        help="axes x, y, th of each module (default left right)",
    )  # fmt: skip
    parser.add_argument(
        "--wrists", nargs="*", default=["wrist1", "wrist2"], metavar="NODE",
        help="force sensor of each wrist, none without a name (default wrist1 wrist2)",
    )  # fmt: skip
