"""Which drivers are installed: the entry points of a group, as ``importlib.metadata`` finds them.

That module brings those for mail, archives and tables along, which a fork server otherwise never needs: a twentieth of
what it takes to start.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any, NamedTuple

_FOLDERS = (".dist-info", ".egg-info")


class Point(NamedTuple):
    """An entry point: its name, and where what it stands for is found, ``module:attribute``."""

    name: str
    value: str

    def load(self) -> Any:
        """Import what it stands for.

        Raises:
            Exception: whatever the module raises; AttributeError, it has no such attribute.
        """
        module, _, attributes = self.value.partition(":")
        found: Any = import_module(module.strip())
        for attribute in attributes.split("[")[0].strip().split(".") if attributes else ():
            found = getattr(found, attribute)
        return found


def entry_points(group: str) -> dict[str, Point]:
    """Return the entry points of a group by name; of packages that are installed twice, those of the first on the path
    count.
    """
    found: dict[str, Point] = {}
    seen: set[str] = set()
    for place in sys.path:
        try:
            names = sorted(os.listdir(place or "."))
        except OSError:  # no folder, or an archive, in which nobody installs drivers
            continue
        for name in names:
            stem, ending = os.path.splitext(name)
            package = stem.partition("-")[0].lower().replace("-", "_").replace(".", "_")
            if ending in _FOLDERS and package not in seen:
                seen.add(package)
                for point in _points(os.path.join(place, name, "entry_points.txt"), group):
                    found[point.name] = point
    return found


def _points(path: str, group: str) -> list[Point]:
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read()
    except OSError:  # most packages have none
        return []
    points, section = [], ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("["):
            section = line.strip("[]").strip()
        elif section == group and "=" in line and not line.startswith(("#", ";")):
            name, _, value = line.partition("=")
            points.append(Point(name.strip(), value.strip()))
    return points
