"""The hand over the drivers of etc/hand.toml, on one thread: its coordinates, its laws, what it refuses."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hand_cell_rig import HandCell, write

from sioms.drivers.compound.hand import MODEL_CHANNELS, HandDriver, known, numbers
from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.world import SimWorld
from sioms.hand.felt import no_shape
from sioms.hand.follow import D
from sioms.hand.kinematics import Hand
from sioms.hand.model import model_of, to_toml
from sioms.hand.survey import BAR, COLUMNS, Survey, Thing, settings
from sioms.hand.touch import Felt, Manner
from sioms.motion import CommandError
from sioms.motion.commands import WIRE_DTYPE
from sioms.protocol.flags import AnalogStatus, AxisStatus, ControlMode
from sioms.tactile.sensing import CHANNELS

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
    assert np.allclose(cell.coordinates, before, atol=5e-4)  # steps of the encoders


def test_a_force_that_meets_nothing_closes_no_further_than_the_spring_yields(cell: HandCell) -> None:
    def small(tables: dict[str, Any]) -> None:
        tables["world"]["object"] = {"shape": "disk", "radius_m": 0.008, "pose": [0.0, 0.3, 0.0]}

    free = HandCell(small, compiled=False)
    before = free.coordinates[D]
    write(free.bank, [(D, True, 1.0)], free.now_ns)
    free.advance(3.0)
    assert before - free.coordinates[D] == pytest.approx(1.0 / 100.0, abs=5e-4)  # f/K_s


def test_a_model_file_says_what_the_hand_is_and_its_node_shows_it(tmp_path: Path) -> None:
    """A longer link moves the coordinates, a finger's mount and load are for whoever reads the node."""
    path = tmp_path / "hand-model.toml"
    path.write_text("[hand]\nlink_m = [0.142, 0.14]\nmount_rad = [0.0, 0.026]\nload_gain = 0.1\nfriction = 1.2\n")
    settings = table(model_file=str(path), link_stiffness=3.0)
    assert HandDriver.transform(settings) == Hand(0.142, 0.14, settings.least_m)
    known_as = known(settings)
    assert numbers(known_as) == (0.142, 0.14, 0.0, 0.026, 3.0, 3.0, 0.1, 0.1, 1.2)
    assert known_as == model_of(to_toml(known_as))
    felt = known_as.corrected(Felt(True, 1.5, 0.01, 1.1), 1)
    assert (felt.phi, felt.force) == pytest.approx((1.526, 1.0))
    shown = [block.channels for block in HandDriver.describe("hand", settings).blocks if block.name == "model"]
    assert [channel.name for channel in shown[0]] == [name for name, _, _ in MODEL_CHANNELS]
    other = HandDriver.describe("hand", table(link_stiffness=3.0))
    assert shown[0] != other.blocks[-1].channels  # a reload takes the other one up


def test_links_as_modelled_put_the_coordinates_where_the_fingers_are(tmp_path: Path) -> None:
    path = tmp_path / "hand-model.toml"
    path.write_text("[hand]\nlink_m = [0.142, 0.14]\n")

    def longer(tables: dict[str, Any]) -> None:
        tables["hand"]["model_file"] = str(path)
        tables["world"]["finger"][0]["mount"]["link_m"] = 0.142

    cell = HandCell(longer, compiled=False)
    one, two = (finger.centre for finger in cell.world.fingers)
    assert cell.coordinates[:2] == pytest.approx([0.5 * (a + b) for a, b in zip(one, two, strict=True)], abs=1e-4)
    assert cell.coordinates[D] == pytest.approx(math.dist(one, two), abs=2e-4)
    assert list(cell.drivers["hand"].blocks[-1].data[:2]) == [0.142, 0.14]


@pytest.mark.parametrize(("text", "said"), [
    (None, "No such file or directory; sioms reconcile hand writes one"),
    ("[hand]\nlinks = 1\n", "nobody reads links"),
    ("[hands]\n", "want [hand] alone"),
    ("[hand]\nlink_m = -1\n", "want above 0"),
    ("[hand]\nlink_m = [1, 2, 3]\n", "want a number, or two"),
    ("[hand]\nload_gain = -1\n", "want above -1"),
    ("[hand]\nmount_rad = nan\n", "want finite numbers"),
])  # fmt: skip
def test_a_model_file_that_is_none_is_refused(tmp_path: Path, text: str | None, said: str) -> None:
    path = tmp_path / "m.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match="model_file") as refused:
        HandDriver.describe("hand", table(model_file=str(path)))
    assert said in str(refused.value)


@pytest.mark.parametrize(("node", "said"), [
    ("touch2.strain", "a finger cannot tell whether anything touches it"),
    ("touch2.strain.e3", "touch2.strain.e3: it has 1 channels; want the shape of a finger"),
])  # fmt: skip
def test_a_node_that_is_no_shape_of_a_finger_tells_no_force(node: str, said: str) -> None:
    """Sixteen raw strains were taken for a shape, one of them for the load."""

    def raw(tables: dict[str, Any]) -> None:
        tables["hand"]["squeeze"]["fingers"] = ["touch1.shape", node]

    cell = HandCell(raw, compiled=False)
    write(cell.bank, [(D, True, 0.5)], cell.now_ns)
    cell.advance(0.02)
    assert cell.bank.rows["status"][D].astype(int) & FAULT
    assert said in cell.bank.fault_text(D)


def test_a_shape_is_known_by_its_channels() -> None:
    assert no_shape("touch2.shape", [name for name, _, _ in CHANNELS]) == ""
    assert "its channels are e0, e1, e2, e3, ...; want the node shape" in no_shape("t", [f"e{i}" for i in range(16)])


def test_the_node_force_tells_how_late_it_is(cell: HandCell) -> None:
    write(cell.bank, [(0, False, 0.01)], cell.now_ns)
    cell.advance(0.1)
    force, filtered, force_age_s, late_s, _, pace = cell.drivers["hand"].blocks[1].data
    assert force == filtered == 0.0 and pace == 1.0
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
        ({"squeeze": {"fingers": ["a", "b"], "spring": 0.0}}, "squeeze: spring 0; want 1e-06 to 1e.09"),
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


def test_a_world_that_waits_for_an_axis_pulls_at_none(cell: HandCell) -> None:
    world, left = cell.drivers["world"], cell.drivers["left"]
    joints = next(block for block in world.blocks if block.spec.name == "left_joints")
    before = [float(at) for at in left.bank.rows["position"]]
    cell.halted.add("world")
    try:
        joints.data[:3] += 0.05  # as if the axes had come back elsewhere
        joints.flags[:] = int(AnalogStatus.INVALID)
        cell.advance(0.05)
    finally:
        cell.halted.discard("world")
    assert np.allclose(left.bank.rows["position"], before, atol=2e-3)


def test_a_mount_that_swings_by_lateness_is_refused() -> None:
    mount = {"stiffness": 2.5e4, "turn_stiffness": 3.0, "mass": 0.2, "inertia": 2e-4}
    axes = ["left.plant.x_position", "left.plant.y_position", "left.plant.th_position"]

    def described(ratio: float) -> None:
        finger = {"name": "left", "axes": axes, "mount": mount | {"damping_ratio": ratio}}
        given = {"object": {"shape": "disk", "radius_m": 0.02}, "finger": [finger]}
        SimWorld.describe("world", msgspec.convert(given, SimWorld.Settings))

    with pytest.raises(ValueError, match=r"finger left: joint x .* 3 ms late; want a damping_ratio above 0\.27"):
        described(0.2)
    described(0.28)


def test_a_module_that_carries_has_three_motors() -> None:
    axis = {"name": "x", "velocity_max": 0.5, "acceleration_max": 5.0, "force_max": 60.0, "motor": {"mass": 1.4}}
    settings = msgspec.convert({"axis": [axis], "carries": "world.left_joints"}, SimAxes.Settings)
    with pytest.raises(ValueError, match="fewer than 3 motors"):
        SimAxes.describe("left", settings)


def test_a_wrist_whose_force_is_invalid_is_not_taken_for_no_contact() -> None:
    def by_wrists(tables: dict[str, Any]) -> None:
        tables["hand"]["squeeze"] = {"wrists": ["wrist1", "wrist2"]}
        for name in ("touch1", "touch2"):
            tables[name]["tick_hz"] = 20.0

    held = HandCell(by_wrists, compiled=False)
    before = held.coordinates[D]
    held.halted.add("wrist2")
    held.drivers["wrist2"].blocks[0].flags[:] = int(AnalogStatus.INVALID)
    write(held.bank, [(D, True, 1.0)], held.now_ns)
    held.advance(0.02)
    assert "wrist2: its force is invalid" in held.bank.fault_text(D)
    assert held.coordinates[D] == pytest.approx(before, abs=1e-4)


def test_both_fingers_bear_alike_while_they_slide_along_what_is_clamped() -> None:
    """Held where the bar is not, by a millimetre, the hand pressed with one finger alone after a second."""

    def clamped(tables: dict[str, Any]) -> None:
        tables["world"]["object"] = {
            "shape": "rectangle", "size_m": [0.03, 0.08], "corner_m": 2e-3, "pose": [1e-3, -2e-3, 0.0], "mass": 50.0,
            "platen_friction": 5.0,
        }  # fmt: skip
        for side, sign in (("left", -1.0), ("right", 1.0)):
            tables[side]["axis"][0]["motor"]["start"] = sign * 0.0317
        for sensor in ("touch1", "touch2", "wrist1", "wrist2"):
            tables[sensor]["tick_hz"] = 100.0

    cell = HandCell(clamped, compiled=False)
    cell.advance(2.0)
    cell.reading = cell._read()
    survey = Survey(cell.hand, cell.reading, Thing(BAR, 0.03), Manner(light_n=0.4, frames=10))
    told = [0.0] * 20

    def feel() -> list[float]:
        told[8:10] = [finger.normal for finger in cell.world.fingers]
        return told

    assert cell.run(survey.slide(settings(1, (0.8,)), feel)) == 1, survey.events
    loads = np.array(survey.rows)[:, [COLUMNS.index("load1"), COLUMNS.index("load2")]]
    assert loads == pytest.approx(np.full((2, 2), 0.8), rel=0.3)
