"""Whether somebody reads a device through others, so that it may rest when nobody does.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

from collections.abc import Callable

from .cell import Cell


def tell_use(cell: Cell, is_open: Callable[[str], bool]) -> None:
    """Tell drivers whether somebody reads them through other devices, directly or not.

    Somebody is who has a node open, and the workcell's stop where an input of a device is to stop it.

    Args:
        cell: the workcell.
        is_open: tells whether somebody has a node of a device open.
    """
    used: set[str] = set()
    readers = [name for name in cell.devices if is_open(name) or cell.watched_inputs.get(name)]
    while readers:
        reader = cell.devices.get(readers.pop())
        for name in reader.info.inputs if reader is not None else ():
            source = cell.names.nodes.get(name)
            if source is not None and source.device not in used:
                used.add(source.device)
                readers.append(source.device)
    for device in cell.devices.values():
        device.tell_use(device.name in used)
