"""Skills on the hand of a running cell: two modules, two fingers, the world between them, in slow motion."""

from __future__ import annotations

import errno
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Daemon, raises, wait_for

from sioms.documents import toml_text
from sioms.hand.live import cell as live
from sioms.hand.live.cell import CellHand
from sioms.hand.skills import Skills
from sioms.hand.slow import slowed
from sioms.hand.touch import Manner

ETC = Path(__file__).resolve().parents[2] / "etc"
PACES = (0.25, 0.05)
"""The second one for a machine that is too busy for the first."""
MANNER = Manner(force_n=0.5, light_n=0.4, closing=0.05, frames=10)


def _config(pace: float) -> str:
    """Return the cell of etc/hand.toml with the fingers at a millimetre from a disk."""
    tables = tomllib.loads((ETC / "hand.toml").read_text(encoding="utf-8"))
    devices: dict[str, Any] = tables["device"]
    devices["world"]["object"] = {"shape": "disk", "radius_m": 0.02, "pose": [0.0, 0.002, 0.0]}
    for side, sign in (("left", -1.0), ("right", 1.0)):
        devices[side]["axis"][0]["motor"]["start"] = sign * 0.0337
    for finger in ("touch1", "touch2"):
        devices[finger]["shape"]["compiled"] = False  # numba takes seconds to start
    return toml_text(slowed(tables, pace, ETC))


@pytest.mark.timeout(400)
def test_an_object_is_grasped_on_a_running_cell(
    start_daemon: Callable[..., Daemon], monkeypatch: pytest.MonkeyPatch
) -> None:
    for pace in PACES:
        daemon = start_daemon(_config(pace), ready=False)
        daemon.said("event=ready", 150.0)
        for device in ("touch1", "touch2", "hand"):
            daemon.wait_up(device, timeout_s=90.0)
        with daemon.cell("hand") as cell:
            before = _shown(cell).position
            with monkeypatch.context() as demanding:
                demanding.setattr(live, "_ENOUGH", 100.0)
                with raises(errno.ETIME, "take the hand", "readings a second"):
                    CellHand(cell)
            assert _shown(cell).position == pytest.approx(before, abs=1e-3)
            try:
                _grasp(cell)
                return
            except OSError as late:
                if late.errno != errno.ETIME or pace == PACES[-1]:
                    raise
        daemon.end()


def _shown(cell: Any) -> Any:
    with cell.open("hand.readonly") as node:
        return node.wait_new(0, 10.0)


def _grasp(cell: Any) -> None:
    cell.reset()
    poses: list[Any] = []
    with CellHand(cell) as hand, cell.open("world.pose") as truth:
        hand.seen = lambda reading, setpoint: poses.append(truth.read().data[:2])
        skills = Skills(hand.hand, hand.reading, MANNER)
        held = hand.run(skills.grasp(), 20.0)
        assert held.force == pytest.approx(0.5, rel=0.15)
        assert held.grasp.apart_m == pytest.approx(0.04, abs=1e-3)
        assert held.grasp.quality < math.radians(12.0)  # 2 mm off the middle of a radius of 20 and a finger's 12.7
        middle = [0.5 * (a + b) for a, b in zip(held.grasp.contact1, held.grasp.contact2, strict=True)]
        assert math.dist(middle, poses[-1]) < 8e-3  # on a busy machine the modules are seen late, and swing
    wait_for(lambda: not any(_shown(cell).in_motion), "the hand stands, let go of")
