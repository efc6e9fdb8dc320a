"""Tables of devices with other values than those that are written, and what the kit says of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sioms.sdk.finding import describe, read_settings

OF_THE_DAEMON = ("driver", "description", "lease_s", "realtime_priority", "hang_s", "process")
"""Keys of a device's table that its driver does not read."""


def changed(table: Any, path: tuple[Any, ...], value: Any) -> Any:
    """Return a table with another value."""
    table = json.loads(json.dumps(table))
    at = table
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return table


def said(driver: Any, table: Any, folder: Path) -> list[str]:
    """Return what is said of a device's table, whose files are in a folder."""
    settings, errors = read_settings(driver, table, str(folder))
    return errors if settings is None else errors + describe(driver, "it", settings)[1]
