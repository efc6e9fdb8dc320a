"""A tactile finger behind the framed sample stream: ``python -m sioms.drivers.framed_adc.simulated.finger --link
PATH``.

The front end of ``adc`` with a simulated finger (``sioms.plant.finger``) on it. What touches it is told by nodes of a
workcell that it
reads as a client: the force on it, where, and how near. While these are not there nothing touches it. Further
command on standard input: ``indenter RADIUS`` (m; 0 an edge, inf a flat), as if somebody changed the tool. What the
finger hides from those who probe it may come in a file (``--finger-file``) that nobody else reads.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np

import sioms
from sioms.plant.finger import FingerShape, TactileArray

from .. import simulator as adc

RETRY_S = 0.5
UNIT = 0.05
"""Default step of the converter, in per cent of the untouched output; a count of the stream."""


class World:
    """What the workcell says of the contact.

    One thread; never waits: readings come from shared pages, and a workcell that is not there is looked for again after
    a while.

    Args:
        path: socket of the daemon, None for the default.
        nodes: of force [N], place [rad] and depth [m], each of one channel; "" for none.
        surface_m: depth at which the finger's surface lies.
    """

    def __init__(self, path: str | None, nodes: tuple[str, str, str], surface_m: float) -> None:
        self._path, self._names, self._surface_m = path, nodes, surface_m
        self._cell: sioms.Workcell | None = None
        self._nodes: list[sioms.AnalogNode | None] = []
        self._retry_s = 0.0

    def contact(self) -> tuple[float, float, float]:
        """Return force [N], place [rad] and clearance [m]."""
        if self._cell is None and not self._open():
            return 0.0, 0.0, math.inf
        try:
            force, place, depth = (0.0 if node is None else node.read().data[0] for node in self._nodes)
        except OSError:
            self._close()
            return 0.0, 0.0, math.inf
        return force, place, max(self._surface_m - depth, 0.0) if self._names[2] else math.inf

    def _open(self) -> bool:
        now_s = time.monotonic()
        if now_s < self._retry_s:
            return False
        self._retry_s = now_s + RETRY_S
        try:
            self._cell = sioms.Workcell(self._path, "finger")
            self._nodes = [self._cell.open(name) if name else None for name in self._names]
        except OSError:
            self._close()
            return False
        return True

    def _close(self) -> None:
        if self._cell is not None:
            self._cell.close()
        self._cell, self._nodes = None, []


class Finger(adc.FrontEnd):
    """The front end; its values are per cent of the untouched output, in steps of the converter."""

    def __init__(
        self, options: argparse.Namespace, array: TactileArray, world: World,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._array, self._world = array, world
        self._radius_m = options.indenter
        self._out = np.zeros(len(array.shape.angles_rad))
        for radius_m in {self._radius_m, *options.mount}:
            array.mount(radius_m)
        super().__init__(options, clock)

    def mount(self, radius: str) -> None:
        """Change the indenter."""
        radius_m = float(radius)
        self._array.mount(radius_m)
        self._radius_m = radius_m

    def _forces(self, now_s: float) -> list[float]:
        force, place, clearance_m = self._world.contact()
        values: list[float] = self._array.read(force, place, self._radius_m, self._out, now_s, clearance_m).tolist()
        return values


def finger_parser() -> argparse.ArgumentParser:
    """Return the options of the front end and those of the finger."""
    parser = adc.options_parser()
    parser.description = "simulated tactile finger behind a framed sample stream"
    parser.set_defaults(noise=0.0, counts_per_newton=1.0 / UNIT, name="FINGER16")
    parser.add_argument("--socket", help="of the daemon")
    parser.add_argument("--force-node", default="prober.plant.radial_contact")
    parser.add_argument("--place-node", default="prober.plant.place_position")
    parser.add_argument("--depth-node", default="prober.plant.radial_position")
    parser.add_argument("--surface", type=float, default=0.010, help="depth of the finger's surface [m]")
    parser.add_argument("--indenter", type=float, default=0.0, help="radius [m], 0 an edge")
    parser.add_argument(
        "--mount",
        type=float,
        nargs="*",
        default=[],
        help="radii tabulated beforehand, to be changed to in no time",
    )
    parser.add_argument("--noise-percent", type=float, default=0.05, help="standard deviation of the outputs")
    parser.add_argument(
        "--finger",
        default="",
        help='fields of the finger as TOML: "gain = 3.0; creep = 0.1" (see sioms.plant.finger)',
    )
    parser.add_argument(
        "--finger-file", type=Path, help="file with further fields, one a line; read once, at the start"
    )
    return parser


def shape_of(text: str, more: str = "") -> FingerShape:
    """Return the finger described by fields, one a line or parted by semicolons; ``more`` of them go before.

    Raises:
        ValueError: not TOML, an unknown field, or a value that makes no sense.
    """
    fields = tomllib.loads(text.replace(";", "\n")) | tomllib.loads(more)
    if "angles_rad" in fields:
        fields["angles_rad"] = tuple(fields["angles_rad"])
    try:
        return FingerShape(**fields)
    except TypeError as error:
        raise ValueError(f"describe finger: {error}") from None


def main() -> None:
    """Serve until told to end."""
    parser = finger_parser()
    options = parser.parse_args()
    try:
        hidden = options.finger_file.read_text(encoding="utf-8") if options.finger_file else ""
        array = TactileArray(shape_of(options.finger, hidden), noise=options.noise_percent, seed=options.seed)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    options.channels = len(array.shape.angles_rad)
    world = World(options.socket, (options.force_node, options.place_node, options.depth_node), options.surface)
    device = Finger(options, array, world)
    asyncio.run(adc.run(device, {"indenter": device.mount}))


if __name__ == "__main__":
    main()
