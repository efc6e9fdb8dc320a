"""The nodes of a tactile finger: the simulated finger senses what presses it, with a force sensor's
help and without.
"""

from __future__ import annotations

import errno
from pathlib import Path

import msgspec
import numpy as np
import pytest

from sioms.drivers.framed_adc.driver import FramedAdc
from sioms.drivers.sim.tactile import SimTactile
from sioms.drivers.tactile_nodes import BEHIND_NS
from sioms.protocol.flags import AnalogStatus, NodeClass, Request
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, BlockSpec, Description
from sioms.sdk.driver import Refusal, TickDriver
from sioms.tactile import cylinder
from sioms.tactile.quality import Quality
from sioms.tactile.sensing import CHANNELS

FINGER = str(Path(__file__).parents[3] / "etc" / "finger.toml")
NAMES = [name for name, _, _ in CHANNELS]


class Hand(TickDriver):
    """Presses: a node of a force [N]."""

    class Settings(msgspec.Struct, frozen=True):
        pass

    @classmethod
    def describe(cls, name, settings):
        return Description((BlockSpec("", NodeClass.ANALOG, (ChannelInfo("force", "N"),)),), 200.0)

    def __init__(self, name, settings, kit):
        super().__init__(name, settings, kit)
        self.force = 0.0
        self._block = AnalogBlock(self.describe(name, settings).blocks[0])

    @property
    def blocks(self):
        return (self._block,)

    def tick(self, now_ns):
        self._block.data[0] = self.force


def table(**shape):
    return {
        "force_node": "hand.force", "angle_rad": 1.4, "noise": 0.023, "resolution": 0.01, "finger": {"gain": 3.0},
        "shape": {"finger_file": FINGER, **shape},
    }  # fmt: skip


def sense(finger):
    return dict(zip(NAMES, finger.blocks[2].data.tolist(), strict=True))


@pytest.fixture
def hand(bench):
    return bench.make(Hand, "hand", {})


def test_shape_is_published_beside_raw_and_strain(bench, hand):
    finger = bench.make(SimTactile, "tactile0", table())
    raw, strain, shape = finger.blocks
    assert [block.spec.name for block in finger.blocks] == ["", "strain", "shape"]
    bench.run(0.05)
    assert sense(finger)["quality"] == Quality.NO_BASELINE.value and shape.flags[1] == int(AnalogStatus.INVALID)
    bench.run(0.1)
    assert sense(finger)["quality"] == Quality.NO_CONTACT.value and sense(finger)["load"] == 0.0
    hand.force = 4.0  # on 20 mm: 200 N/m
    bench.run(0.05)
    felt = sense(finger)
    assert felt["quality"] == Quality.GOOD.value and set(shape.flags) == {0}
    assert felt["angle"] == pytest.approx(1.4, abs=3e-3)
    assert felt["load"] == pytest.approx(200.0, rel=0.05)
    assert felt["radius"] == pytest.approx(6e-3, rel=0.4)
    np.testing.assert_allclose(strain.data, -0.03 * raw.data, atol=1.5e-3)


def test_what_the_device_calls_saturated_is_so_in_strain_and_shape(bench, hand):
    """A front end says so of a whole frame: no element can be left out, and nothing be called good."""
    finger = bench.make(SimTactile, "tactile0", table())
    bench.run(0.2)
    nodes, raw = finger._finger, finger.blocks[0].data.copy()
    nodes.take(raw, np.full(16, int(AnalogStatus.SATURATED)), 10**12, 10**12)
    assert set(nodes.strain.flags) == {int(AnalogStatus.SATURATED)}
    assert all(flags & int(AnalogStatus.SATURATED) for flags in nodes.shape.flags)
    nodes.take(raw, np.zeros(16, dtype=np.int64), 10**12 + 10**6, 10**12)
    assert not any(flags & int(AnalogStatus.SATURATED) for flags in nodes.shape.flags)


def test_what_only_the_tables_needed_is_given_back(bench, hand):
    body = cylinder.Cylinder(9.6e-3, 12.7e-3, 0.499)
    cylinder.respond(body, np.arange(4.0), 0.01)  # tables of the file's own body may be there already
    assert cylinder._amplitudes.cache_info().currsize
    bench.make(SimTactile, "tactile0", table())
    assert cylinder._amplitudes.cache_info().currsize == 0


def test_load_of_a_force_sensor_is_used_while_it_is_there(bench, hand):
    finger = bench.make(SimTactile, "tactile0", table(load_node="hand.force", load_scale=50.0, load_deviation=0.5))
    bench.run(0.15)
    hand.force = 4.0
    bench.run(0.05)
    felt = sense(finger)
    assert felt["quality"] == Quality.GOOD.value
    assert felt["var_load"] < 0.5**2 and felt["load"] == pytest.approx(200.0, abs=2.0)
    bench._drivers = [entry for entry in bench._drivers if entry[0] is finger]  # the sensor's process hangs
    bench.run(0.2)
    felt = sense(finger)
    assert felt["quality"] == Quality.WITHOUT_LOAD.value and felt["var_load"] > 0.5**2


def test_requests_rebase_load_fingers_and_hold_gains(bench, hand):
    finger = bench.make(SimTactile, "tactile0", table())
    _, strain, shape = (block.spec for block in finger.blocks)
    bench.run(0.15)
    zero = finger.ioctl(shape, Request.ZERO_DEVICE, [], 20)
    bench.run(0.05)
    assert zero.ready() is None and sense(finger)["quality"] == Quality.NO_CONTACT.value  # by the old baseline
    bench.run(0.15)
    assert zero.ready() == ([0.0] * len(CHANNELS),)
    finger.ioctl(strain, Request.SET_GAINS, [], [6.0] * 16)
    gains = np.array(finger.ioctl(strain, Request.GET_GAINS, [], None)).reshape(16, 16)
    np.testing.assert_array_equal(gains, 6.0 * np.eye(16))
    hand.force = 4.0
    bench.run(0.05)
    assert sense(finger)["load"] == pytest.approx(400.0, rel=0.05)  # twice the strain
    assert finger.ioctl(shape, Request.CALIBRATE_DEVICE, [], Path(FINGER).read_text()) == "demo"
    hand.force = 0.0
    bench.run(0.15)
    hand.force = 4.0
    bench.run(0.05)
    assert sense(finger)["load"] == pytest.approx(200.0, rel=0.05)


def ask_zero(finger, argument=None):
    return finger.ioctl(finger.blocks[2].spec, Request.ZERO_DEVICE, [], argument).ready


def test_a_touched_finger_is_not_zeroed(bench, hand):
    finger = bench.make(SimTactile, "tactile0", table())
    bench.run(0.15)
    hand.force = 4.0
    bench.run(0.05)
    with pytest.raises(Refusal, match=r"touched \(\d+ N/m at 80 degrees\).*baseline stays") as caught:
        ask_zero(finger)
    assert caught.value.errno == errno.EBUSY
    bench.run(0.05)
    assert sense(finger)["load"] == pytest.approx(200.0, rel=0.05)
    # one who knows better has a way
    assert finger.ioctl(finger.blocks[2].spec, Request.CALIBRATE_DEVICE, [], []) == "demo"
    bench.run(0.15)
    assert sense(finger)["touched"] == 0.0
    hand.force = 0.0  # what had its baseline under a touch shows a pull, and may be zeroed
    bench.run(0.05)
    assert Quality.WRONG_SIGN in Quality(int(sense(finger)["quality"]))
    ready = ask_zero(finger)
    bench.run(0.2)
    assert ready() is not None and sense(finger)["touched"] == 0.0
    hand.force = 4.0
    bench.run(0.05)
    assert sense(finger)["load"] == pytest.approx(200.0, rel=0.05)


@pytest.mark.parametrize("force", [4.0, 0.05])
def test_what_touches_while_the_baseline_is_taken_refuses_it(bench, hand, force):
    """A load of 2.5 N/m is below what a frame notices, but not below what a baseline of 200 frames does."""
    finger = bench.make(SimTactile, "tactile0", table())
    bench.run(0.15)
    ready = ask_zero(finger, 200)
    bench.run(0.55)
    hand.force = force
    bench.run(0.55)
    with pytest.raises(Refusal, match="baseline was taken") as caught:
        ready()
    assert caught.value.errno == errno.EBUSY
    bench.run(0.05)
    assert sense(finger)["touched"] == float(force > 1.0)


def test_readings_from_before_the_request_make_no_baseline(bench, hand):
    """A frame carries the time at which it was measured; those that were on their way do not count."""
    finger = bench.make(SimTactile, "tactile0", table())
    bench.run(0.15)
    bench.clock_ns += 100_000_000  # the request comes late, and the frames since then come after it
    ready = ask_zero(finger)
    bench.clock_ns -= 100_000_000
    bench.run(0.16)
    assert ready() is None
    bench.run(0.05)
    assert ready() is not None


def test_a_blind_finger_is_not_zeroed(bench):
    """The node that it feels is not there: its readings are INVALID."""
    finger = bench.make(SimTactile, "tactile0", table())
    bench.inputs["hand.force"].read = lambda now_ns: {"value": np.zeros(1)}
    bench.run(0.15)
    still = ask_zero(finger)
    bench.inputs["hand.force"].read = lambda now_ns: None
    bench.run(0.05)
    with pytest.raises(Refusal, match=r"blind: its elements cannot tell.*baseline stays"):
        ask_zero(finger)
    bench.run(0.1)
    with pytest.raises(Refusal, match="blind: 0 of 16 elements gave readings"):
        still()
    begun = bench.make(SimTactile, "tactile1", table())
    ready = ask_zero(begun)  # it never had a baseline
    bench.run(0.15)
    with pytest.raises(Refusal, match="blind: 0 of 16"):
        ready()


def test_zeros_at_the_same_time_are_one_and_end_with_the_finger(bench, hand):
    finger = bench.make(SimTactile, "tactile0", table())
    bench.run(0.15)
    ready = ask_zero(finger)
    bench.run(0.05)
    later = ask_zero(finger)
    bench.run(0.08)
    assert ready() is None and later() is None
    bench.run(0.05)
    assert ready() == later() is not None
    ready = ask_zero(finger)
    finger.ioctl(finger.blocks[2].spec, Request.CALIBRATE_DEVICE, [], None)
    with pytest.raises(Refusal, match="another finger"):
        ready()
    for wrong in (0, -1, 1.5, [1], "2", True):
        with pytest.raises(Refusal, match="want 1 to 100000"):
            ask_zero(finger, wrong)


@pytest.mark.parametrize(
    "node, request_, argument, words",
    [
        (1, Request.SET_GAINS, [1.0], "1 gains; want 16, or 16 rows of 16"),
        (1, Request.SET_GAINS, [-1.0] * 16, "not positive"),
        (1, Request.SET_GAINS, [1e300] * 16, "want 1e-12 to 1e\\+12"),
        (1, Request.SET_GAINS, {"a": 1}, "not 'dict'"),
        (2, Request.SET_GAINS, [1.0] * 16, "not a request shape knows"),
        (2, Request.CALIBRATE_DEVICE, "x = 1", "unknown field `x`"),
        (2, Request.CALIBRATE_DEVICE, [1.0], "want the text of a finger's file"),
        (0, Request.CALIBRATE_DEVICE, "", "not a request this device knows"),
    ],
)
def test_requests_that_make_no_sense_are_refused(bench, hand, node, request_, argument, words):
    finger = bench.make(SimTactile, "tactile0", table())
    with pytest.raises(Refusal, match=words):
        finger.ioctl(finger.blocks[node].spec, request_, [], argument)


@pytest.mark.parametrize(
    "shape, words",
    [
        ({"finger_file": "/none/finger.toml"}, "No such file"),
        ({"finger_file": __file__}, "load finger"),
        ({"load_node": "force0.fz", "load_scale": 0.0}, "scale is 0.0"),
        ({"load_age_s": 0.0}, "want a positive time"),
        ({"settle_frames": 0}, "want 1 or more"),
    ],
)
def test_settings_that_cannot_be_are_told_before_the_start(shape, words):
    with pytest.raises(ValueError, match=words):
        SimTactile.describe("tactile0", msgspec.convert(table(**shape), SimTactile.Settings))


def test_a_finger_of_another_number_of_elements_is_told(tmp_path):
    settings = {"line": {"serial": "/x", "baud": 921600}, "channels": 8, "shape": {"finger_file": FINGER}}
    with pytest.raises(ValueError, match="has 16 elements; the device has 8"):
        FramedAdc.describe("t0", msgspec.convert(settings, FramedAdc.Settings))


def test_shapes_are_left_out_where_frames_come_faster_than_they_are_estimated(bench, hand):
    nodes = bench.make(SimTactile, "tactile0", table())._finger
    raw, flags, late_ns = np.zeros(nodes.strain.n), np.zeros(nodes.strain.n, dtype=np.int64), BEHIND_NS + 1
    now = nodes._kit.now_ns()
    assert nodes.take(raw, flags, now, now, now) == (nodes.strain, nodes.shape)
    assert nodes.take(raw, flags, now + 1, now, now - late_ns) == (nodes.strain,)
    assert nodes.shape.stamp_ns == now and nodes.strain.stamp_ns == now + 1
    assert nodes.take(raw, flags, now + 2, now) == (nodes.strain, nodes.shape)  # the only one that has come
    assert (nodes.shape.flags & AnalogStatus.OVERRUN).all() and not (nodes.strain.flags & AnalogStatus.OVERRUN).any()
    nodes.take(raw, flags, now + 3, now, now)
    assert not (nodes.shape.flags & AnalogStatus.OVERRUN).any()
