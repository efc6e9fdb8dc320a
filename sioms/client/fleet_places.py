"""Which cells a fleet has: a file of names and addresses.

    # ~/.config/sioms/fleet.toml, or $SIOMS_FLEET
    [cells]
    left = "zenoh://lab1:5780"
    right = "zmq://lab2:5770"

A name is that of the cell itself, ``name`` of its ``[workcell]``.
"""

from __future__ import annotations

import errno
import os
import tomllib
from collections.abc import Iterable, Mapping

from sioms.protocol.text import printable

VARIABLE = "SIOMS_FLEET"
MOST_BYTES = 1 << 20


def default_path() -> str:
    """Return $SIOMS_FLEET, else the user's own file."""
    base = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    return os.environ.get(VARIABLE) or f"{base}/sioms/fleet.toml"


def read(path: str = "") -> dict[str, str]:
    """Return the addresses of the cells by their names.

    Args:
        path: of the file; '' = ``default_path``.

    Raises:
        OSError: no such file, or none of a fleet.
    """
    path = path or default_path()
    try:
        with open(path, "rb") as file:
            data = file.read(MOST_BYTES + 1)
    except FileNotFoundError:
        raise OSError(
            errno.ENOENT, f"read the fleet {path}: no such file; write one with a line NAME = \"zenoh://HOST:PORT\" "
            "for each cell below [cells]"
        ) from None  # fmt: skip
    try:
        if len(data) > MOST_BYTES:
            raise ValueError(f"more than {MOST_BYTES} bytes")
        table = tomllib.loads(data.decode())
        cells = table.pop("cells", None)
        if table or not isinstance(cells, dict) or not all(isinstance(each, str) for each in cells.values()):
            raise ValueError('want a table [cells] with NAME = "ADDRESS", and nothing else')
    except tomllib.TOMLDecodeError as error:
        from sioms.toml_errors import explained  # slow to import, and seldom needed

        raise OSError(errno.EINVAL, f"read the fleet {path}: {explained(data.decode(), error)}") from None
    except ValueError as error:
        raise OSError(errno.EINVAL, f"read the fleet {path}: {error}") from None
    return {checked(name): address for name, address in cells.items()}


def checked(name: str) -> str:
    """Return the name of a cell; raises OSError for one that nodes could not be told by."""
    if not name or ":" in name or "/" in name or not name.isprintable():
        raise OSError(errno.EINVAL, f"name a cell {printable(name)!r}: want a name without : and /")
    return name


def wanted(cells: Mapping[str, str] | Iterable[str] | str | None) -> list[tuple[str, str]]:
    """Return name and address of each cell; the name is '' where it is not known before."""
    if cells is None or isinstance(cells, str):
        cells = read(cells or "")
    if isinstance(cells, Mapping):
        return [(checked(name), address) for name, address in cells.items()]
    return [("", address) for address in cells]


def claim(name: str, called: str, address: str, taken: Mapping[str, str]) -> str:
    """Return by which name a cell is known in the fleet.

    Args:
        name: what the fleet calls it, '' = nothing.
        called: what it calls itself.
        address: of it.
        taken: addresses by name of those that are known.

    Raises:
        OSError: EINVAL it calls itself otherwise; EEXIST another one has its name.
    """
    what = f"open the fleet: the cell at {address} calls itself {printable(called)!r}"
    if name and name != called:
        raise OSError(
            errno.EINVAL, f"{what} and the fleet {name!r}; correct name in its [workcell], or the fleet's file"
        )
    if called in taken:
        raise OSError(
            errno.EEXIST, f"{what}, as does the one at {taken[called]}; give one of them another name in [workcell]"
        )
    return checked(called)
