"""A held disk that sticks to the platen: what brings the hand back to its goal does not throw it about."""

from __future__ import annotations

import math
import tomllib
from typing import Any

import numpy as np
from hand_cell_rig import ETC, HandCell, write

from sioms.hand.follow import Follower
from sioms.hand.touch import Setpoint

RADIUS, FINGER, LINK, PSI, PHI = 0.02, 0.0127, 0.14, 0.3, (1.9, 1.2)
FORCE_N = 1.8


class Held(HandCell):
    """The cell of etc/hand.toml about a disk, fingers rolled; wrists tell the force, for estimators take time."""

    def __init__(self) -> None:
        def change(devices: dict[str, Any]) -> None:
            del devices["touch1"], devices["touch2"]
            squeeze = devices["hand"]["squeeze"]
            del squeeze["fingers"]
            squeeze["wrists"] = ["wrist1", "wrist2"]
            devices["world"]["object"] = {"shape": "disk", "radius_m": RADIUS}
            reach = RADIUS + FINGER + 1e-3
            for side, sign, th in (("left", -1.0, PSI - PHI[0]), ("right", 1.0, PSI - PHI[1] + math.pi)):
                x, y = sign * reach * math.cos(PSI), sign * reach * math.sin(PSI)
                start = x - LINK * math.cos(th), y - LINK * math.sin(th), th
                for axis, at in zip(devices[side]["axis"], start, strict=True):
                    axis["motor"]["start"] = at
            for wrist in ("wrist1", "wrist2"):
                devices[wrist]["tick_hz"] = 200.0

        super().__init__(change)

    def _read(self) -> Any:
        return None


def test_a_held_disk_comes_to_rest_near_where_the_hand_is_to_be() -> None:
    cell = Held()
    goal: Any = list(cell.coordinates)
    write(cell.bank, [(3, True, FORCE_N)], cell.now_ns)
    cell.advance(1.6)
    goal[2] += 0.08
    goal[5] -= 0.1
    devices = tomllib.loads((ETC / "hand.toml").read_text(encoding="utf-8"))["device"]
    follower = Follower(most=[0.999 * axis["velocity_max"] for axis in devices["hand"]["axis"]])
    worst = np.zeros(6)
    for _ in range(420):
        orders = follower.orders(Setpoint(tuple(goal), (0.0,) * 6, FORCE_N), cell.coordinates, FORCE_N, 7.5e-3)
        write(cell.bank, orders, cell.now_ns)
        cell.advance(7.5e-3)
        worst = np.maximum(worst, np.abs(cell.bank.rows["following_error"]))
        assert not any(cell.bank.fault_text(axis) for axis in range(6)), cell.bank.fault_text(0)
    off = np.abs(np.subtract(cell.coordinates, goal))
    assert worst[[2, 4, 5]].max() < 0.03 and off[[2, 4, 5]].max() < 0.015
    assert min(finger.normal for finger in cell.world.fingers) > 1.6
