"""The hand over the drivers of etc/hand.toml, on one thread: its coordinates, its laws, what it refuses."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hand_cell_rig import HandCell, write

from sioms.drivers.compound.hand import HandDriver
from sioms.hand.follow import D
from sioms.motion import CommandError
from sioms.motion.commands import WIRE_DTYPE
from sioms.protocol.flags import AxisStatus, ControlMode

FAULT = int(AxisStatus.FAULT)


@pytest.fixture(scope="module")
def cell() -> HandCell:
    return HandCell(compiled=False)


def to(cell: HandCell, **places: float) -> None:
    """Command positions of coordinates."""
    names = list(HandDriver.COORDINATES)
    records = np.zeros(len(places), WIRE_DTYPE)
    for record, (name, place) in zip(records, places.items(), strict=True):
        record["axis"], record["control_mode"], record["position"] = names.index(name), int(ControlMode.POSITION), place
    cell.drivers["hand"].admit(records.tolist(), range(6))
    cell.bank.append(records, np.arange(6), cell.now_ns)


def table(**keys: Any) -> Any:
    """Return settings of a hand."""
    axis = [{"name": name, "velocity_max": 0.2, "acceleration_max": 2.0} for name in HandDriver.COORDINATES]
    given = {"axes": ["left", "right"], "axis": axis, "squeeze": {"fingers": ["touch1.shape", "touch2.shape"]}}
    return msgspec.convert(given | keys, HandDriver.Settings)


def test_six_coordinates_move_six_axes(cell: HandCell) -> None:
    q = {"x": 0.01, "y": -0.02, "psi": 0.3, "d": 0.2, "phi1": 1.4, "phi2": 1.7}
    to(cell, **q)
    cell.advance(1.5)
    assert np.allclose(cell.coordinates, list(q.values()), atol=6e-3)
    joints = [float(p) for name in ("left", "right") for p in cell.drivers[name].bank.rows["position"]]
    assert np.allclose(joints, cell.hand.inverse(cell.coordinates), atol=2e-3)


def test_what_no_module_reaches_is_refused_and_nothing_moves(cell: HandCell) -> None:
    before = cell.coordinates
    with pytest.raises(CommandError, match=r"left: y|right: y|left: x|right: x"):
        to(cell, x=0.29, y=0.39, psi=1.5)
    cell.advance(0.1)
    assert np.allclose(cell.coordinates, before, atol=1e-4)


def test_a_force_that_meets_nothing_closes_no_further_than_the_spring_yields(cell: HandCell) -> None:
    def small(tables: dict[str, Any]) -> None:
        tables["world"]["object"] = {"shape": "disk", "radius_m": 0.008, "pose": [0.0, 0.3, 0.0]}

    free = HandCell(small, compiled=False)
    before = free.coordinates[D]
    write(free.bank, [(D, True, 1.0)], free.now_ns)
    free.advance(3.0)
    assert before - free.coordinates[D] == pytest.approx(1.0 / 100.0, abs=5e-4)  # f/K_s


def test_the_node_force_tells_how_late_it_is(cell: HandCell) -> None:
    write(cell.bank, [(0, False, 0.01)], cell.now_ns)
    cell.advance(0.1)
    force, filtered, force_age_s, late_s, _ = cell.drivers["hand"].blocks[1].data
    assert force == filtered == 0.0
    assert 0.0 <= force_age_s < 5e-3 and 0.0 <= late_s < 3e-3


def test_a_finger_that_dies_stops_the_squeeze_and_says_which(cell: HandCell) -> None:
    write(cell.bank, [(D, True, 0.5)], cell.now_ns)
    cell.advance(0.1)
    assert abs(cell.bank.rows["velocity"][D]) > 1e-3
    cell.halted.add("touch2")
    cell.advance(0.2)
    status = cell.bank.rows["status"].astype(int)
    assert (status & FAULT).all()
    assert "touch2.shape" in cell.bank.fault_text(D) and "s old" in cell.bank.fault_text(D)
    before = cell.coordinates
    cell.advance(0.1)
    assert np.allclose(cell.coordinates, before, atol=1e-3)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"squeeze": {}}, "neither or both"),
        ({"squeeze": {"fingers": ["a", "b"], "wrists": ["c", "d"]}}, "neither or both"),
        ({"squeeze": {"fingers": ["a", "b"], "damper": 2.0}}, "unstable at 400 Hz"),
        ({"squeeze": {"fingers": ["a", "b"], "spring": 0.0}}, "spring is 0"),
        ({"link1_m": 0.0}, "link1_m is 0"),
        ({"link_stiffness": -1.0}, "link_stiffness -1"),
    ],
)
def test_settings_that_cannot_be_are_refused(keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        HandDriver.describe("hand", table(**keys))


def test_wrist_sensors_tell_the_force_along_the_line_of_centres() -> None:
    from sioms.hand.felt import wrist_force

    psi, squeeze = 0.7, 1.3
    c, s = math.cos(psi), math.sin(psi)
    across = (-0.4 * s, 0.4 * c)  # of friction
    one = (-squeeze * c + across[0], -squeeze * s + across[1])
    two = (squeeze * c - across[0], squeeze * s - across[1])
    assert wrist_force(one, two, psi, 0.02) == pytest.approx(squeeze)
    assert wrist_force(one, (0.0, 0.0), psi, 0.02) == 0.0
    assert wrist_force(two, one, psi, 0.02) == 0.0  # it pulls
