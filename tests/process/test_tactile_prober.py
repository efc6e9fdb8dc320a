"""A finger behind the real framed stream, probed by axes, with a force sensor: shape in the driver, and the
recordings.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from daemon_rig import wait_for

import sioms
from sioms.protocol.flags import Request
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.files import read_folder
from sioms.tactile.finger import nominal_finger, to_toml
from sioms.tactile.live.prober import LENGTH_M, Prober, Rig, Touch, write_nominal
from sioms.tactile.live.simulated import simulated
from sioms.tactile.quality import Quality

CONFIG = Path(__file__).parents[2] / "etc" / "prober.toml"
ANGLES = np.radians(143.0 - 9.22 * np.arange(16))
SHAPE = """
[device.tactile0.shape]
finger_file = "finger.toml"
load_node = "force0.fz"
load_scale = 83.333
"""


def felt(node: sioms.AnalogNode) -> dict[str, float]:
    return dict(zip((channel.name for channel in node.info.channels), node.read().data, strict=True))


def test_probing_is_felt_in_the_driver_and_recorded_for_calibration(short_folder: Path) -> None:
    text = to_toml(nominal_finger(FINGER_B, ANGLES, 10.3e-3, 3.0, 5.3e-4))
    (short_folder / "finger.toml").write_text(text)
    finger = f"gain = 3.0; length_m = {LENGTH_M}"
    place = math.radians(80.0)
    with (
        simulated(short_folder, finger, (6e-3,), CONFIG.read_text() + SHAPE) as mount,
        sioms.Workcell(name="test") as cell,
        Prober(cell, mount, Rig(lease_s=30.0)) as prober,
    ):
        prober.prepare(6e-3, place)
        with cell.open("tactile0.shape") as shape, cell.open("tactile0.strain") as strain:
            wait_for(lambda: felt(shape)["quality"] == Quality.NO_CONTACT.value, "an untouched finger")
            prober.go(place, 6e-3)
            prober.press(200.0)
            found = wait_for(lambda: (now := felt(shape))["quality"] == 0.0 and now, "a good estimate")
            assert abs(math.degrees(found["angle"] - place)) < 0.5
            assert abs(found["load"] - 200.0) < 12.0
            assert 3e-3 < found["radius"] < 12e-3
            assert min(strain.read().data) < -0.05
            gains = strain.ioctl(Request.GET_GAINS)
            assert np.allclose(np.reshape(gains, (16, 16)), 3.0 * np.eye(16))
            prober.clear()
            assert strain.ioctl(Request.CALIBRATE_DEVICE, text) == "nominal"
            wait_for(lambda: felt(shape)["quality"] == Quality.NO_CONTACT.value, "the finger loaded anew")
        plan = [Touch(math.radians(d), 200.0, 6e-3) for d in (60.0, 90.0)]
        prober.run(plan, lambda what: None, "two touches").save(short_folder / "two.npz")
    write_nominal(short_folder / "nominal.json", ANGLES)
    touches = read_folder(short_folder).touches["two"]
    assert np.allclose(np.degrees(touches.angle_rad), (60.0, 90.0))
    assert np.allclose(touches.force, 200.0, atol=15.0)
    for output, angle in zip(touches.output, touches.angle_rad, strict=True):
        assert abs(ANGLES[output.argmax()] - angle) < math.radians(5.0) and 0.03 < output.max() < 0.06
