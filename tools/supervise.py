"""``sioms supervise``: the supervisor of a fleet, without whom cells that ask for one stop.

It does nothing but live and be connected: a cell stops when the process ends or hangs, or the link is lost.
"""

from __future__ import annotations

import argparse
import errno
import sys
import time
from typing import Any

from sioms.arguments import positive
from sioms.client.fleet_places import wanted
from sioms.client.workcell import Workcell

LEASE_S = 1.0
AGAIN_S = 1.0
"""How often a cell that is not there is tried again [s]."""


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "supervise",
        help="supervise the cells of a fleet, which stop without a supervisor",
        description="Supervises every cell of the fleet until interrupted. Cells whose configuration has "
        "supervisor_lease_s stop when no supervisor is left; `sioms reset` clears that, with one present.",
    )
    parser.add_argument("--fleet", metavar="FILE", default="", help="default: $SIOMS_FLEET, or the user's own")
    parser.add_argument(
        "--lease", metavar="SECONDS", type=positive, default=LEASE_S, help="time-out of supervision; default 1 s"
    )


def run(args: argparse.Namespace) -> int:
    """Supervise until told to end."""
    places = wanted(args.fleet or None)
    cells = [Supervised(name, address, args.lease) for name, address in places]
    if not cells:
        raise OSError(errno.ENOENT, "supervise: the fleet has no cells")
    while True:
        now_s = time.monotonic()
        for cell in cells:
            cell.look(now_s)
        time.sleep(args.lease / 8)


class Supervised:
    """A cell that is supervised.

    Args:
        name: of the cell; address: of it.
        lease_s: longest silence [s].
    """

    def __init__(self, name: str, address: str, lease_s: float) -> None:
        self._name, self._address, self._lease_s = name, address, lease_s
        self._cell: Workcell | None = None
        self._due_s = 0.0
        self._told = ""

    def look(self, now_s: float) -> None:
        """Renew the lease when that is due; connect again when the session has been lost."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + self._lease_s / 4
        try:
            if self._cell is None:
                self._cell = Workcell(self._address, "supervise")
            asked_s = self._cell.supervise(self._lease_s)
            if asked_s:
                self._due_s = now_s + min(asked_s, self._lease_s) / 4
            self._tell(
                f"supervised, {f'stops after {min(asked_s, self._lease_s):g} s' if asked_s else 'asks for none'}"
            )
        except OSError as error:
            if self._cell is not None:
                self._cell.close()
                self._cell = None
            self._due_s = now_s + AGAIN_S
            self._tell(error.strerror or str(error))

    def _tell(self, text: str) -> None:
        if text != self._told:
            self._told = text
            print(f"{self._name or self._address}: {text}", file=sys.stderr, flush=True)
