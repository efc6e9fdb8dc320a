"""ATI Net F/T and Ethernet Axia (also SCHUNK FTN and FTR-Axia) on RDT: a stream of UDP records at up to 7 kHz.

Scaling, units, serial number and rate are read from the sensor's page at every opening.

    [device.force0]
    driver = "ati-rdt"
    line = { udp = "192.168.1.1:49152" }
    rate_hz = 1000
    full_scale = [330, 330, 990, 30, 30, 30]
"""

from __future__ import annotations

import errno
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from sioms.protocol.flags import AnalogStatus, Request
from sioms.sdk.blocks import AnyBlock, BlockSpec, Description
from sioms.sdk.codec import ati_rdt as rdt
from sioms.sdk.codec import http_get
from sioms.sdk.codec.clock_fit import ClockFit
from sioms.sdk.codec.sequence import SequenceWatch
from sioms.sdk.datagram import split_address
from sioms.sdk.driver import Kit, StreamDriver
from sioms.sdk.exchange import Aside, DeviceError, LinkError, Pause, Send, Steps
from sioms.sdk.force_torque import ForceBlock, ForceSettings, check_whole, force_spec
from sioms.sdk.golden import Golden
from sioms.sdk.settings import LineSettings

MARGIN_S = 0.1
"""The stream has stalled when nothing came for three periods and this."""
STOPS = 3
"""A stop may be lost on its way and draws no answer, so it is sent so often."""
STOP_PAUSE_S = 0.02
PAGE_TIMEOUT_S = 2.0
TRUSTED_NS = 2_000_000_000
"""A sensor that was silent for less than this is still the same one: only the stream is started again."""
CLOCK_TOLERANCE = 0.01
CLOCK_CHECK_NS = 5_000_000_000
"""Long enough that records which arrive together do not matter."""
LOOK_AT_THE_SENSOR = "look at host and port, and that RDT is enabled on the sensor's communication page"


class AtiRdtSettings(ForceSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the device, beside those of ForceSettings.

    Attributes:
        line: the sensor's UDP port, ``host:49152``.
        rate_hz: of the records as set on the sensor's communication page [Hz].
        buffered: several records in a datagram: fewer packets, later.
        page: ``host:port`` of the sensor's web server, the host of the line and port 80 without; "none" if it cannot be
            reached: then model and counts must be given, and nothing tells one sensor from another.
        counts_per_force, counts_per_torque: counts in a N and in a N m; read from the sensor's page without.
        model: "net" or "axia", whose status words differ; by the product's name without.
        serial_number: of the calibrated transducer, e.g. "FT12345"; anything without.
        sample_hz: the sensor's internal samples in a second, which its records are stamped with [Hz].
    """

    rate_hz: float = 1000.0
    buffered: bool = False
    page: str = ""
    counts_per_force: float = 0.0
    counts_per_torque: float = 0.0
    model: Literal["", "net", "axia"] = ""
    serial_number: str = ""
    sample_hz: float = rdt.SAMPLE_HZ


class AtiRdt(StreamDriver):
    """One sensor.

    Concurrency: the one thread of the driver process.
    """

    Settings = AtiRdtSettings
    advice = LOOK_AT_THE_SENSOR

    @classmethod
    def describe(cls, name: str, settings: AtiRdtSettings) -> Description:
        """Tell the channels; raises ValueError for settings that contradict each other."""
        _check(settings)
        spec = force_spec(settings.full_scale, settings.history, "ATI force/torque sensor")
        return Description((spec,), settings.rate_hz, lease_s=max(0.5, 10 / settings.rate_hz))

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return datagrams of the manual."""
        record = rdt.Record(1, 1, 0, 1000000, -2000000, 3000000, 10000, -20000, 30000)
        sent = "00 00 00 01 00 00 00 01 00 00 00 00 00 0f 42 40 ff e1 7b 80 00 2d c6 c0 00 00 27 10 ff ff b1 e0 00 00 75 30"
        start = rdt.start(rdt.Command.REALTIME, MARGIN_S)
        return (
            Golden("start", start, "12 34 00 02 00 00 00 00"),
            Golden(
                "record", reply=sent, value=record, read=lambda data: start.decode(data[: rdt.RECORD_BYTES])
            ),
            Golden("stop", rdt.request(rdt.Command.STOP), "12 34 00 00 00 00 00 00"),
            Golden("bias", rdt.request(rdt.Command.BIAS), "12 34 00 42 00 00 00 00"),
        )

    def __init__(self, name: str, settings: AtiRdtSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._page_host = "" if settings.page == "none" else _page_host(settings)
        self.aside = LineSettings(tcp=self._page_host) if self._page_host else None
        self.silence_s = 3 / settings.rate_hz + MARGIN_S
        self._block = ForceBlock(self.describe(name, settings).blocks[0], name, kit)
        self._model = rdt.Model(settings.model or "net")
        if not self._page_host:
            self._block.set_scale(1 / settings.counts_per_force, 1 / settings.counts_per_torque)
        self._sequence = SequenceWatch(rdt.SEQUENCE_MODULUS)
        self._clock = SampleClock(name, settings.sample_hz, kit)
        self._status: int | None = None
        self._records = self._malformed = 0
        self._heard_ns = 0
        self._known = ""

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The six components."""
        return (self._block,)

    def open(self) -> Steps:
        """Read the sensor's page, compare, and start the stream; after a short stall start it at once."""
        now_ns = time.monotonic_ns()
        if self._page_host and not (self._known and now_ns - self._heard_ns < TRUSTED_NS):
            host = split_address(self._page_host)[0]
            try:
                page = yield Aside(http_get.get(host, rdt.PAGE, rdt.parse_page, PAGE_TIMEOUT_S))
            except LinkError as error:
                raise LinkError(f"identify {self.name}: {error}") from None
            self._identify(page)
        yield from self._stop(1)
        self._sequence.expect_anew()
        self._clock.expect_anew()
        command = rdt.Command.BUFFERED if self.settings.buffered else rdt.Command.REALTIME
        try:
            first: rdt.Record = yield rdt.start(command, self.silence_s)
        except LinkError as error:
            raise LinkError(f"{self.name} on {self.line}: {error}; {LOOK_AT_THE_SENSOR}") from None
        self._sequence.accept(first.rdt_seq)

    def feed(self, data: bytes, now_ns: int) -> int:
        """Publish the fresh records of a datagram."""
        records = rdt.parse(data)
        if records is None:
            self._malformed += 1
            return 0
        good = 0
        for record in records:
            lost = self._sequence.accept(record.rdt_seq)
            if lost is None:
                continue
            flags = int(AnalogStatus.OVERRUN) if lost else 0
            if record.status != self._status or record.status:
                flags |= self._judge(record.status, now_ns)
            self._block.show(record[3:], self._clock.to_host(record.ft_seq, now_ns), flags)
            good += 1
        self._records += good
        self._heard_ns = now_ns
        return good

    def ioctl(self, block: BlockSpec, request: Request, channels: Sequence[int], argument: Any) -> Any:
        """Let the sensor take the present load as its zero (bias), on CALIBRATE_DEVICE of the whole node."""
        if request is not Request.CALIBRATE_DEVICE:
            return super().ioctl(block, request, channels, argument)
        check_whole(block, channels)
        return self._bias()

    def counters(self) -> Mapping[str, int | str]:
        """Return what came, and the status of the last record."""
        seen, block = self._sequence, self._block
        return {
            "records": self._records, "malformed": self._malformed, "lost": seen.lost, "late": seen.late,
            "doubled": seen.doubled, "sequence_restarts": seen.restarts, "clock_restarts": self._clock.restarts,
            "saturated": block.saturated, "invalid": block.invalid, "status": block.status,
        }  # fmt: skip

    def close(self) -> Steps:
        """Stop the stream; without that the sensor sends on for ever."""
        yield from self._stop(STOPS)

    # --- inside ----------------------------------------------------------------------------------

    def _stop(self, times: int) -> Steps:
        for _ in range(times):
            yield Send(rdt.request(rdt.Command.STOP), "stop the stream")
            yield Pause(STOP_PAUSE_S)

    def _bias(self) -> Steps:
        yield Send(rdt.request(rdt.Command.BIAS), "bias")
        self._block.offset[:] = 0.0

    def _judge(self, status: int, now_ns: int) -> int:
        """Return the flags of a status word, and tell of its change."""
        model = self._model
        if status != self._status:
            self._status = status
            self._block.say(rdt.status_text(status, model), now_ns)
        flags = int(AnalogStatus.INVALID) if rdt.is_invalid(status, model) else 0
        return flags | (int(AnalogStatus.SATURATED) if rdt.is_saturated(status, model) else 0)

    def _identify(self, page: rdt.SensorPage) -> None:
        """Compare the sensor's page with the settings, and take its scaling; raises DeviceError when they differ."""
        settings = self.settings
        force, torque = rdt.force_unit(page.force_unit), rdt.torque_unit(page.torque_unit)
        if force is None or torque is None:
            raise self._not_this(
                f"gives its units as {page.force_unit!r} and {page.torque_unit!r}; set N and Nm on its page"
            )
        model = rdt.Model.AXIA if "axia" in page.product.lower() else rdt.Model.NET
        if settings.model and settings.model != model.value:
            raise self._not_this(f"is a {page.product!r}; the configuration says model = {settings.model}")
        if settings.serial_number and settings.serial_number != page.serial:
            raise self._not_this(
                f"has serial number {page.serial!r}; the configuration says {settings.serial_number!r}"
            )
        if abs(page.rate_hz - settings.rate_hz) > 0.01 * settings.rate_hz:
            raise self._not_this(
                f"sends {page.rate_hz:g} records/s; the configuration says rate_hz = {settings.rate_hz:g}; change one of them"
            )
        counts = (page.counts_per_force / force, page.counts_per_torque / torque)
        for key, value in zip(("counts_per_force", "counts_per_torque"), counts, strict=True):
            wanted = getattr(settings, key)
            if wanted and abs(wanted - value) > 1e-6 * value:
                raise self._not_this(
                    f"has {value:g} counts in an SI unit; the configuration says {key} = {wanted:g}"
                )
        self._model = model
        self._block.set_scale(1 / counts[0], 1 / counts[1])
        known = f"{page.product}, serial number {page.serial}, {page.rate_hz:g} records/s"
        if known != self._known:
            self._known = known
            self.kit.log("info", f"identified {self.name} on {self.line}: {known}")

    def _not_this(self, what: str) -> DeviceError:
        return DeviceError(errno.ENODEV, f"identify {self.name} at {self._page_host}: the sensor {what}")


class SampleClock:
    """Maps the sensor's count of internal samples to the host's time, once that count has the rate it should have.

    Args:
        name: of the device.
        sample_hz: counts a second [Hz].
        kit: for what is to be said.
    """

    def __init__(self, name: str, sample_hz: float, kit: Kit) -> None:
        self._name, self._sample_hz, self._kit = name, sample_hz, kit
        self._fit = ClockFit(round(1e9 / sample_hz), rdt.SEQUENCE_MODULUS)
        self._first: tuple[int, int] | None = None
        self._checked = False
        self._trusted = True
        self._last_ns = 0

    @property
    def restarts(self) -> int:
        """Times the sensor's count began anew."""
        return self._fit.restarts

    def expect_anew(self) -> None:
        """Forget the count: the sensor may have lost its power."""
        self._fit.expect_anew()
        self._first = None

    def to_host(self, count: int, now_ns: int) -> int:
        """Return the time of a sample [ns, CLOCK_MONOTONIC]; its arrival when the count has another rate."""
        if not self._checked:
            self._check(count, now_ns)
        if self._trusted:
            self._last_ns = max(self._fit.to_host(count, now_ns), self._last_ns)
        else:
            self._last_ns = max(now_ns, self._last_ns)
        return self._last_ns

    def _check(self, count: int, now_ns: int) -> None:
        if self._first is None:
            self._first = count, now_ns
            return
        elapsed_ns = now_ns - self._first[1]
        if elapsed_ns < CLOCK_CHECK_NS:
            return
        self._checked = True
        rate_hz = (count - self._first[0]) % rdt.SEQUENCE_MODULUS / elapsed_ns * 1e9
        if abs(rate_hz / self._sample_hz - 1) > CLOCK_TOLERANCE:
            self._trusted = False
            self._kit.log(
                "warning",
                f"{self._name}: the sensor counts {rate_hz:.0f} samples/s, not sample_hz = {self._sample_hz:g}; "
                f"readings are stamped with their arrival; set sample_hz = {rate_hz:.0f}",
            )


def _page_host(settings: AtiRdtSettings) -> str:
    return settings.page or (settings.line.udp or "").rpartition(":")[0] + ":80"


def _check(settings: AtiRdtSettings) -> None:
    if settings.line.udp is None:
        raise ValueError('line: RDT is UDP; want line = { udp = "host:49152" }')
    if split_address(settings.line.udp)[1] == 0:
        raise ValueError(f"line.udp = {settings.line.udp}: requests need a port; want 49152")
    for key in ("rate_hz", "sample_hz"):
        if not 1 <= getattr(settings, key) <= 20_000:
            raise ValueError(f"{key} = {getattr(settings, key):g}; want 1 to 20000")
    for key in ("counts_per_force", "counts_per_torque"):
        if not 0 <= getattr(settings, key) < 1e12:
            raise ValueError(f"{key} = {getattr(settings, key):g}; want a positive number")
        if settings.page == "none" and not getattr(settings, key):
            raise ValueError(f'{key}: none given; page = "none" needs it, from the calibration sheet')
    if settings.page == "none" and (not settings.model or settings.serial_number):
        raise ValueError(
            'page = "none": want model = "net" or "axia", and no serial_number, which RDT does not tell'
        )
    if settings.page != "none":
        LineSettings(tcp=_page_host(settings))
