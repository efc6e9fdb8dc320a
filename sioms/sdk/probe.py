"""Looks at a driver without a device: ``python -m sioms.sdk.probe DRIVER FOLDER [TABLE]``, one JSON object on standard
output.

For tools, which know no driver: its rig, its kind, and what came of its golden frames. TABLE is the device's table as
    JSON.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from .driver import Driver
from .finding import DriverNotFound, find_driver, kind_of, read_settings
from .golden import try_golden


def main(words: Sequence[str]) -> int:
    """Print what there is to say; return 1 when the driver does not load."""
    name, folder = words[0], words[1]
    try:
        driver = find_driver(name, folder)
        settings = _settings(driver, json.loads(words[2]), folder) if len(words) > 2 else None
        outcomes = [asdict(try_golden(each)) for each in driver.golden(settings)]
    except (DriverNotFound, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    print(json.dumps({"kind": kind_of(driver), "rig": dict(driver.rig), "golden": outcomes}))
    return 0


def _settings(driver: type[Driver], table: dict[str, Any], folder: str) -> Any:
    settings, errors = read_settings(driver, table, folder)
    if errors:
        raise ValueError("; ".join(errors))
    return settings


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
