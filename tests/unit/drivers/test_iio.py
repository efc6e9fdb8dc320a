"""Linux IIO: finding a device among several, its attributes, and settings that contradict each other."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from sioms.drivers.iio.device import IioDevice, find_device
from sioms.drivers.iio.driver import Iio, IioRaw
from sioms.drivers.iio.simulator import Dummy
from sioms.plant.finger import FingerShape, TactileArray
from sioms.sdk.exchange import LinkError
from sioms.tactile.sensing import CHANNELS


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    for number, name in enumerate(("adc", "gyro", "adc")):
        folder = tmp_path / f"iio:device{number}"
        folder.mkdir()
        (folder / "name").write_text(f"{name}\n")
    (tmp_path / "iio:device2" / "label").write_text("left\n")
    return tmp_path


def test_devices_are_found_by_name_label_and_number(sysfs: Path) -> None:
    assert find_device(str(sysfs), "gyro").name == "iio:device1"
    assert find_device(str(sysfs), "left").name == "iio:device2"
    assert find_device(str(sysfs), "iio:device0").name == "iio:device0"
    with pytest.raises(LinkError, match="2 bear that name; want one of iio:device0, iio:device2"):
        find_device(str(sysfs), "adc")
    with pytest.raises(
        LinkError, match=r"there is iio:device0 \(adc\), iio:device1 \(gyro\), iio:device2 \(adc, left\)"
    ):
        find_device(str(sysfs), "thermo")


def test_scaling_is_the_channels_own_or_its_kinds(sysfs: Path) -> None:
    device = IioDevice(sysfs / "iio:device0")
    for attribute, value in {
        "in_voltage_scale": 2.0, "in_voltage1_scale": 3.0, "in_voltage1_offset": -5.0, "in_voltage-voltage_scale": 4.0,
    }.items():  # fmt: skip
        (device.folder / attribute).write_text(f"{value}\n")
    assert device.scaling("voltage0") == (0.0, 2.0)
    assert device.scaling("voltage1") == (-5.0, 3.0)
    assert device.scaling("voltage0-voltage1") == (0.0, 4.0)
    assert device.scaling("temp") == (0.0, 1.0)
    with pytest.raises(LinkError, match="in_temp_raw: no such attribute"):
        device.number("in_temp_raw")
    (device.folder / "in_temp_raw").write_text("\n")
    with pytest.raises(LinkError, match="'' is not a number"):
        device.number("in_temp_raw")
    with pytest.raises(LinkError, match=r"write 1 to .*buffer/enable: no such attribute"):
        device.write("buffer/enable", 1)


def attributes(folder: Path, **values: object) -> IioDevice:
    for attribute, value in values.items():
        path = folder / attribute.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{value}\n")
    return IioDevice(folder)


def test_a_name_that_ends_by_a_zero(sysfs: Path) -> None:
    """As the kernel tells its clocks: sizeof("monotonic\\n") bytes."""
    assert (
        attributes(sysfs / "iio:device0", current_timestamp_clock="monotonic\n\0").read("current_timestamp_clock")
        == "monotonic"
    )


def test_a_trigger_with_a_rate_takes_the_place_of_the_devices_own(sysfs: Path) -> None:
    device = attributes(sysfs / "iio:device0", trigger__current_trigger="", sampling_frequency=860)
    with pytest.raises(LinkError, match=r"set trigger 'timer' of iio:device0: there is none; mkdir .*hrtimer/NAME"):
        device.set_trigger("timer")
    attributes(sysfs / "trigger0", name="timer", sampling_frequency=100)
    attributes(sysfs / "trigger1", name="adc-ready")
    with pytest.raises(LinkError, match="there is timer, adc-ready"):
        device.set_trigger("clock")
    assert device.set_trigger("") is None
    timer = device.set_trigger("timer")
    assert timer is not None and device.set_trigger("") is not None, "it is left"
    assert device.set_rate(timer, ["voltage0"], 25.0)
    assert (timer.number("sampling_frequency"), device.number("sampling_frequency")) == (25.0, 860.0)
    assert device.set_rate(device.set_trigger("adc-ready"), ["voltage0"], 128.0)
    assert device.number("sampling_frequency") == 128.0


def test_a_rate_that_only_is_told(sysfs: Path) -> None:
    device = attributes(sysfs / "iio:device0", in_voltage0_sampling_frequency_available="128 250 860")
    rate = device.folder / "in_voltage0_sampling_frequency"
    assert not device.set_rate(None, ["voltage0"], 100.0), "nothing tells a rate"
    rate.symlink_to("/proc/sys/kernel/ngroups_max")  # may be read and not written, by root neither
    with pytest.raises(LinkError, match="rate_hz = 100, but iio:device0 samples at 65536 Hz; want one of 128 250 860"):
        device.set_rate(None, ["voltage0"], 100.0)
    assert device.set_rate(None, ["voltage0"], 65536.0)


class Kit:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.published: list[tuple[int, list[float], int]] = []

    def publish(self, block: Any, stamp_ns: int) -> None:
        self.published.append((stamp_ns, block.data.tolist(), int(block.flags[0])))


def test_scans_without_a_clock_of_ours_are_mapped(tmp_path: Path) -> None:
    """A device that stamps with the wall clock, and one that does not stamp at all."""
    dummy = Dummy(tmp_path, 0, "dummy")
    dummy.plug()
    (dummy.root / "current_timestamp_clock").unlink()
    table = {"device": "dummy", "channels": ["voltage0"], "mode": "buffer", "rate_hz": 100.0, "trigger": "instance1",
             "sysfs": str(tmp_path / "sysfs"), "dev": str(tmp_path / "dev")}  # fmt: skip
    try:
        for stamped in (True, False):
            kit = Kit()
            if not stamped:
                for name in ("en", "index", "type"):
                    (dummy.root / f"scan_elements/in_timestamp_{name}").unlink()
            driver = Iio("a", msgspec.convert(table, Iio.Settings), kit)  # type: ignore[arg-type]
            assert list(driver.open()) == []
            # the machine may keep this test waiting between the opening and here
            began_s = (driver._began_ns or time.monotonic_ns()) / 1e9 + 0.005
            scans = [dummy._scan(began_s + (i - 1) / 100) for i in range(6)]
            taken = driver.feed(b"".join(scans[not stamped :]), round((began_s + 1) * 1e9))
            assert taken == 5, "the kit calls the link good by what was published"
            stamps = [stamp for stamp, _, _ in kit.published]
            wanted = began_s if stamped else began_s + 0.96  # the scan from before the opening is not taken
            assert stamps == pytest.approx([(wanted + i / 100) * 1e9 for i in range(5)], abs=2e6)
            assert np.array([data for _, data, _ in kit.published]) == pytest.approx(80 * 1.3333e-3)
            list(driver.close())
    finally:
        dummy.unplug()


@pytest.fixture
def dummy(tmp_path: Path) -> Iterator[Dummy]:
    dummy = Dummy(tmp_path, 0, "dummy")
    dummy.plug()
    yield dummy
    dummy.unplug()


def driver_of(dummy: Dummy, kit: Kit, mode: str) -> Any:
    table = {"device": "dummy", "channels": ["voltage0"], "mode": mode, "rate_hz": 100.0,
             "sysfs": str(dummy.root.parent), "dev": str(dummy.fifo.parent)}  # fmt: skip
    if mode == "buffer":
        table["trigger"] = "instance1"
    settings = msgspec.convert(table, Iio.Settings)
    return Iio.variant(settings)("a", settings, kit)  # type: ignore[arg-type]


def test_a_process_that_waits_between_two_clocks_stamps_as_ever(dummy: Dummy, monkeypatch: pytest.MonkeyPatch) -> None:
    (dummy.root / "current_timestamp_clock").unlink()
    kit = Kit()
    driver = driver_of(dummy, kit, "buffer")
    list(driver.open())
    scan_s = time.monotonic()
    scan = dummy._scan(scan_s)
    waits, clock = iter((0.02, 0.0, 0.03)), time.time_ns

    def held_up() -> int:
        wall_ns = clock()
        time.sleep(next(waits, 0.0))
        return wall_ns

    monkeypatch.setattr(time, "time_ns", held_up)
    assert driver.feed(scan, round((scan_s + 1) * 1e9)) == 1
    assert kit.published[0][0] == pytest.approx(scan_s * 1e9, abs=5e6)


def test_a_scan_that_comes_again_is_none(dummy: Dummy) -> None:
    """Equal values are a quiet input; an equal time is a buffer that stands still."""
    kit = Kit()
    driver = driver_of(dummy, kit, "buffer")
    assert list(driver.open()) == []
    dummy.standstill.set("0")
    began_s = time.monotonic()
    for i in range(1, 6):
        assert driver.feed(dummy._scan(began_s + i / 100), round((began_s + 1) * 1e9)) == 1
    for opening in range(2):
        for _ in range(20):
            assert driver.feed(dummy._scan(began_s + 0.05), round((began_s + 1) * 1e9)) == 0
        assert "the time at which they were taken stands still" in driver.trouble or opening
        assert list(driver.open()) == []
    assert len(kit.published) == 5 and driver.counters()["old_scans"] >= 20
    list(driver.close())


@pytest.mark.parametrize("mode", ["raw", "buffer"])
def test_a_scale_that_another_program_sets_is_told_before_it_is_read_wrong(dummy: Dummy, mode: str) -> None:
    kit = Kit()
    driver = driver_of(dummy, kit, mode)
    words = "voltage0 has offset 7, scale 2.5 after offset 7, scale 1.3333: another program has set it"
    if mode == "buffer":
        assert list(driver.open()) == []
        assert list(driver.heartbeat()) == []
        now_s = time.monotonic()
        assert driver.feed(dummy._scan(now_s), round(now_s * 1e9) + 10**6) == 1
        dummy.foreign("scale", "2.5")
        assert list(driver.heartbeat()) == []
        with pytest.raises(LinkError, match=words):
            driver.feed(dummy._scan(now_s + 0.01), round(now_s * 1e9) + 10**8)
        assert list(driver.open()) == []
        assert driver.feed(dummy._scan(time.monotonic()), round(time.monotonic() * 1e9) + 10**8) == 1
        assert kit.published[-1][1] == pytest.approx([80 * 2.5e-3])
        return
    driver.open()
    now_ns = time.monotonic_ns()
    driver.tick(now_ns)
    dummy.foreign("scale", "2.5")
    with pytest.raises(LinkError, match=words):
        driver.tick(now_ns + 2 * 10**9)
    driver.open()
    driver.tick(now_ns + 3 * 10**9)
    assert list(driver.blocks[0].data) == pytest.approx([80 * 2.5e-3])


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"channels": []}, "channels: none given"),
        ({"channels": ["voltage0", "voltage0"]}, "voltage0 is given 2 times"),
        ({"channels": ["in_voltage0_raw"]}, "want the name alone, e.g. voltage0"),
        ({"rate_hz": 5000.0}, "rate_hz = 5000; want 0.1 to 1000 in mode raw"),
        ({"trigger": "t"}, "readings in mode raw have none"),
        ({"mode": "buffer", "watermark": 300}, "watermark = 300, buffer_length = 256"),
    ],
)
def test_bad_configurations(table: dict[str, Any], words: str) -> None:
    settings = msgspec.convert({"device": "adc", "channels": ["voltage0"], **table}, Iio.Settings)
    with pytest.raises(ValueError, match=words):
        Iio.describe("a", settings)


def test_the_mode_chooses_the_class() -> None:
    for mode, kind in (("raw", IioRaw), ("buffer", Iio)):
        assert Iio.variant(msgspec.convert({"device": "adc", "channels": ["temp"], "mode": mode}, Iio.Settings)) is kind


def test_channels_of_a_converter_are_a_finger(sysfs: Path, bench: Any) -> None:
    """Volts of sixteen elements, 2 V untouched: a touch is told as behind any other front end."""
    folder, finger = sysfs / "iio:device1", Path(__file__).parents[3] / "etc" / "finger.toml"
    values = attributes(folder, in_voltage_scale=1.0)  # the kernel's millivolts
    table: dict[str, Any] = {
        "device": "gyro", "channels": [f"voltage{n}" for n in range(16)], "sysfs": str(sysfs), "rate_hz": 100.0,
        "shape": {"finger_file": str(finger)}, "element_scale": 50.0, "element_offset": 2.0,
    }  # fmt: skip
    array, random = TactileArray(FingerShape(gain=3.0)), np.random.default_rng(3)

    def read(load: float) -> dict[str, float]:
        output = -100.0 / 3.0 * array.strain(load, 1.2, 6e-3) + 0.02 * random.normal(size=16)
        for number, value in enumerate(output):
            attributes(values.folder, **{f"in_voltage{number}_raw": 2000.0 + 20.0 * value})
        made.tick(bench.clock_ns)
        return dict(zip((name for name, _, _ in CHANNELS), made.blocks[2].data.tolist(), strict=True))

    made = bench.make(IioRaw, "adc0", table)
    for number in range(16):
        attributes(folder, **{f"in_voltage{number}_raw": 2000.0})
    made.open()
    for _ in range(30):
        rest = read(0.0)
    assert rest["touched"] == 0.0 and rest["load"] == 0.0
    felt = [read(200.0) for _ in range(10)]
    assert np.mean([one["load"] for one in felt]) == pytest.approx(200.0, abs=4.0)
    assert felt[-1]["angle"] == pytest.approx(1.2, abs=0.01) and felt[-1]["quality"] == 0.0
    assert made.blocks[0].data[0] == pytest.approx(2.0, abs=0.1)  # its own node stays in SI
    for wrong, words in (
        ({"element_offset": [1.0, 2.0]}, "2 for 16 channels"),
        ({"element_scale": 0.0}, "want finite numbers, not 0"),
    ):
        with pytest.raises(ValueError, match=words):
            Iio.describe("adc0", msgspec.convert({**table, **wrong}, Iio.Settings))
