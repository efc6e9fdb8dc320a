"""Which file is which node: ``mod0.xaxis`` is ``mod0/xaxis``. Pure.

A node whose name begins those of others, as ``mod0``, is a folder of them, and itself a file beside it, ``mod0.all``.
Each file has a twin of binary records, ``mod0/xaxis.bin``. Parts of names hold no dots, so none of these can be
another's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sioms.client.cell_verbs import NodeEntry
from sioms.protocol.flags import READONLY

WHOLE, BINARY = ".all", ".bin"
STOP, LOG = ".stop", ".log"


@dataclass(frozen=True, slots=True)
class NodePlace:
    """A file of a node.

    Attributes:
        name: of the node.
        binary: whether it takes and gives records instead of text.
        read_only: whether it can be written.
    """

    name: str
    binary: bool
    read_only: bool


class Tree:
    """The files of some nodes.

    Args:
        entries: nodes; companions are left out.

    Example:
        >>> axis = ["mod0", 3, 2, False, "mod0", "up", "", -1], ["mod0.xaxis", 3, 1, False, "mod0", "up", "", -1]
        >>> tree = Tree([NodeEntry(list(each)) for each in axis])
        >>> tree.folder("/"), tree.folder("/mod0")
        (['mod0', 'mod0.all', 'mod0.all.bin'], ['xaxis', 'xaxis.bin'])
        >>> tree.place("/mod0/xaxis")
        NodePlace(name='mod0.xaxis', binary=False, read_only=False)
    """

    def __init__(self, entries: Iterable[NodeEntry] = ()) -> None:
        self._files: dict[str, NodePlace] = {}
        self._folders: dict[str, set[str]] = {"": set()}
        nodes = {e.name: e for e in entries if not e.name.endswith(READONLY) and _fits(e.name)}
        above = {parent for name in nodes for parent in _parents(name)}
        for name, entry in nodes.items():
            path = name.replace(".", "/") + (WHOLE if name in above else "")
            self._add(path, NodePlace(name, False, entry.read_only))
            self._add(path + BINARY, NodePlace(name, True, entry.read_only))

    def _add(self, path: str, place: NodePlace) -> None:
        self._files[path] = place
        while path:
            folder, _, last = path.rpartition("/")
            self._folders.setdefault(folder, set()).add(last)
            path = folder

    def folder(self, path: str) -> list[str] | None:
        """Return what is in a folder, None where there is no such folder."""
        found = self._folders.get(path.strip("/"))
        return None if found is None else sorted(found)

    def place(self, path: str) -> NodePlace | None:
        """Return what file this is, None for none."""
        return self._files.get(path.strip("/"))


def _parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[:count]) for count in range(1, len(parts))]


def _fits(name: str) -> bool:
    return all(part and "/" not in part and "\0" not in part for part in name.split("."))
