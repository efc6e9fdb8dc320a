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
from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

from sioms.protocol.flags import AnalogStatus, Request
from sioms.sdk.blocks import AnyBlock, BlockSpec, Description
from sioms.sdk.codec.sequence import SequenceWatch
from sioms.sdk.datagram import split_address
from sioms.sdk.device_clock import DeviceClock
from sioms.sdk.driver import Kit, StreamDriver
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, Pause, Send, SideExchange, Step, Steps
from sioms.sdk.force_torque import ForceBlock, ForceSettings, check_whole, force_spec
from sioms.sdk.golden import Golden
from sioms.sdk.settings import LineSettings

from . import codec as rdt
from . import http_get

MARGIN_S = 0.1
"""The stream has stalled when nothing came for three periods and this."""
STOPS = 3
"""A stop may be lost on its way and draws no answer, so it is sent so often."""
STOP_PAUSE_S = 0.02
PAGE_TIMEOUT_S = 2.0
TRUSTED_NS = 2_000_000_000
"""A sensor that was silent for less than this is still the same one: only the stream is started again."""
PAGE_S = 5.0
"""Period in which the page is read while it streams: RDT does not tell that somebody changed the settings or the zero.
"""
OLD_S, OLD_RECORDS = 0.1, rdt.MAX_RECORDS
"""Samples so far behind the newest, or by so many records, are old ones; farther ones are of a sensor that has
restarted.
"""
BIAS_TRIES, BIAS_PAUSE_S = 3, 0.05
TAKEN_PAUSE_NS = 60_000_000_000
CHECK_THE_SENSOR = "check host and port, and that RDT is enabled on the sensor's communication page"
TAKEN = (
    "the stream had ended while the sensor ran on: the network lost it, or another client took it, for RDT serves one; "
    "look for other programs that ask this sensor"
)


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
        sample_hz: the sensor's internal samples in a second, which its records are stamped with [Hz]; read from the
            sensor's page without, and measured where it does not tell, or tells wrong.
    """

    rate_hz: float = 1000.0
    buffered: bool = False
    page: str = ""
    counts_per_force: float = 0.0
    counts_per_torque: float = 0.0
    model: Literal["", "net", "axia"] = ""
    serial_number: str = ""
    sample_hz: float = 0.0


class AtiRdt(StreamDriver):
    """One sensor.

    Concurrency: the one thread of the driver process.
    """

    Settings = AtiRdtSettings
    advice = CHECK_THE_SENSOR

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
        sent = (
            "00 00 00 01 00 00 00 01 00 00 00 00 00 0f 42 40 ff e1 7b 80 00 2d c6 c0 00 00 27 10 ff ff b1 e0 00 00 75 "
            "30"
        )
        start = rdt.start(rdt.Command.REALTIME, MARGIN_S)
        return (
            Golden("start", start, "12 34 00 02 00 00 00 00"),
            Golden("record", reply=sent, value=record, read=lambda data: start.decode(data[: rdt.RECORD_BYTES])),
            Golden("stop", rdt.request(rdt.Command.STOP), "12 34 00 00 00 00 00 00"),
            Golden("bias", rdt.request(rdt.Command.BIAS), "12 34 00 42 00 00 00 00"),
        )

    def __init__(self, name: str, settings: AtiRdtSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._page_host = "" if settings.page == "none" else _page_host(settings)
        self.side_line = LineSettings(tcp=self._page_host) if self._page_host else None
        self.silence_s = 3 / settings.rate_hz + MARGIN_S
        self._block = ForceBlock(self.describe(name, settings).blocks[0], name, kit)
        self._model = rdt.Model(settings.model or "net")
        if not self._page_host:
            self._block.set_scale(1 / settings.counts_per_force, 1 / settings.counts_per_torque)
        self.heartbeat_s = PAGE_S if self._page_host else 0.0
        self._sequence = SequenceWatch(rdt.SEQUENCE_MODULUS, settings.rate_hz)
        self._clock = DeviceClock(
            name, kit, settings.sample_hz or rdt.SAMPLE_HZ, rdt.SEQUENCE_MODULUS, "set sample_hz = {hz}"
        )
        self._status: int | None = None
        self._records = self._malformed = self._repeated = 0
        self._heard_ns = 0
        self._newest: tuple[int, int] | None = None
        self._page: rdt.SensorPage | None = None
        self._changed = ""
        self._skipped_pages = self._failed_pages = 0
        self._taken_ns = -TAKEN_PAUSE_NS
        self._known = ""

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The six components."""
        return (self._block,)

    def open(self) -> Steps:
        """Read the sensor's page, compare, and start the stream; after a short stall start it at once.

        A sensor whose samples went on meanwhile has kept its power, and so its settings and its zero. One that counts
        anew is looked at again before it is read.
        """
        is_known = self._known and time.monotonic_ns() - self._heard_ns < TRUSTED_NS and not self._changed
        if self._page_host and not is_known:
            yield from self._look()
        first = yield from self._start()
        if self._newest is None or self._is_old(first.ft_seq):
            return  # a sample that was seen already tells nothing: the sensor may be frozen
        if not self._is_same_run(first.ft_seq):
            self._doubt_zero("the sensor restarted")
            if self._page_host and is_known:
                yield from self._look()
                first = yield from self._start()
            self._newest = first.ft_seq, time.monotonic_ns()
        elif time.monotonic_ns() - self._taken_ns > TAKEN_PAUSE_NS:
            self._taken_ns = time.monotonic_ns()
            self.kit.log("warning", f"{self.name} on {self.line}: {TAKEN}")

    def feed(self, data: bytes, now_ns: int) -> int:
        """Publish the fresh records of a datagram."""
        if self._changed:
            raise LinkError(f"{self.name} at {self._page_host}: {self._changed}")
        records = rdt.parse(data)
        if records is None:
            self._malformed += 1
            return 0
        good = 0
        for record in records:
            lost = self._sequence.accept(record.rdt_seq, now_ns)
            if lost is None:
                self.trouble = f"records come, but their number stands still at {record.rdt_seq}: the sensor is frozen"
                continue
            if not self._is_new_sample(record.ft_seq, now_ns):
                continue
            flags = int(AnalogStatus.OVERRUN) if lost else 0
            if record.status != self._status or record.status:
                flags |= self._judge(record.status, now_ns)
            self._block.show(record[3:], self._clock.to_host(record.ft_seq, now_ns), flags)
            good += 1
        if good:
            self._records += good
            self._heard_ns, self.trouble = now_ns, ""
        return good

    def heartbeat(self) -> Steps:
        """Look at the sensor's page: somebody else may have set another zero, other units or another rate."""
        if self._skipped_pages < self._failed_pages:
            self._skipped_pages += 1
            return
        self._skipped_pages = 0
        try:
            page: rdt.SensorPage = yield SideExchange(self._get_page())
        except (LinkError, DeviceError):
            self._failed_pages = min(2 * self._failed_pages + 1, 11)  # once a minute in the end
            return
        self._failed_pages = 0
        before, self._page = self._page, page
        if before is None:
            return
        if page.bias != before.bias:
            self._block.lose_zero(
                "the vector on its page is another: another client, or its page, has set the sensor's zero"
            )
        if replace(page, bias=()) != replace(before, bias=()):
            self._changed = "its page tells other settings than at its opening: somebody has changed them"

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
            "doubled": seen.doubled, "sequence_restarts": seen.restarts, "repeated": self._repeated,
            "saturated": block.saturated, "invalid": block.invalid, "status": block.status, **self._clock.counters(),
        }  # fmt: skip

    def close(self) -> Steps:
        """Stop the stream; without that the sensor sends on for ever."""
        yield from self._stop(STOPS)

    # --- inside ----------------------------------------------------------------------------------

    def _stop(self, times: int) -> Steps:
        for _ in range(times):
            yield Send(rdt.request(rdt.Command.STOP), "stop the stream")
            yield Pause(STOP_PAUSE_S)

    def _start(self) -> Generator[Step, Any, rdt.Record]:
        """Stop a stream that may still run, and start it; the value is its first record."""
        yield from self._stop(1)
        self._sequence.expect_anew()
        self._clock.expect_anew()
        self.trouble = ""
        command = rdt.Command.BUFFERED if self.settings.buffered else rdt.Command.REALTIME
        try:
            first: rdt.Record = yield rdt.start(command, self.silence_s)
        except LinkError as error:
            raise LinkError(f"{self.name} on {self.line}: {error}; {CHECK_THE_SENSOR}") from None
        return first

    def _is_new_sample(self, count: int, now_ns: int) -> bool:
        """Tell whether a record holds a sample that was not seen before; raises LinkError when the count began anew."""
        if self._newest is not None:
            last = self._newest[0]
            if self._is_old(count):
                self._repeated += 1
                self.trouble = f"records come, but the sensor's count of samples stands still at {last}"
                return False
            if (count - last) % rdt.SEQUENCE_MODULUS > rdt.SEQUENCE_MODULUS // 2:
                self._doubt_zero("the sensor restarted")
                self._newest, self._known = (count, now_ns), ""
                raise LinkError(f"{self.name}: its samples are counted from {count} after {last}: it has restarted")
        self._newest = count, now_ns
        return True

    def _is_old(self, count: int) -> bool:
        """Tell whether a sample is the newest one or a little before it."""
        behind = 0 if self._newest is None else (self._newest[0] - count) % rdt.SEQUENCE_MODULUS
        oldest_s = max(OLD_S, OLD_RECORDS / self.settings.rate_hz)
        return self._newest is not None and behind <= oldest_s * self._clock.measured_hz

    def _is_same_run(self, count: int) -> bool:
        """Tell whether the sensor has counted on since it was last heard."""
        if self._newest is None:
            return False
        last, last_ns = self._newest
        expected = (time.monotonic_ns() - last_ns) * 1e-9 * self._clock.measured_hz
        step = (count - last + rdt.SEQUENCE_MODULUS // 2) % rdt.SEQUENCE_MODULUS - rdt.SEQUENCE_MODULUS // 2
        return abs(step - expected) <= 0.05 * expected + 0.3 * self._clock.measured_hz

    def _doubt_zero(self, why: str) -> None:
        """Tell that a zero is gone; one that the page still shows will be found there."""
        if self._block.is_zeroed:
            self._block.lose_zero(f"{why}, and with it goes its bias")

    def _bias(self) -> Steps:
        """Have the zero taken; where the page tells the sensor's bias, until it does."""
        for attempt in range(BIAS_TRIES):
            yield Send(rdt.request(rdt.Command.BIAS), "bias")
            if self._page is None or not self._page.bias:
                break
            yield Pause(BIAS_PAUSE_S)
            try:
                page: rdt.SensorPage = yield SideExchange(self._get_page())
            except LinkError as error:
                self.kit.log("warning", f"{self.name}: the bias could not be looked up: {error}")
                break
            before, self._page = self._page.bias, page
            if page.bias != before:
                break
            if attempt + 1 == BIAS_TRIES:
                self.kit.log("warning", f"{self.name}: the sensor shows the same bias as before: was it the same load")
        self._block.take_zero()

    def _get_page(self) -> Exchange:
        return http_get.get(split_address(self._page_host)[0], rdt.PAGE, rdt.parse_page, PAGE_TIMEOUT_S)

    def _look(self) -> Steps:
        """Read the sensor's page, and take from it what is needed."""
        self._changed = self._known = ""
        try:
            page: rdt.SensorPage = yield SideExchange(self._get_page())
        except LinkError as error:
            raise LinkError(f"identify {self.name}: {error}") from None
        before, self._page = self._page, page
        self._identify(page)
        if before is not None and before.bias != page.bias:
            self._block.lose_zero("the sensor's bias is not the one it had when it was last read")

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
                f"sends {page.rate_hz:g} records/s; the configuration says rate_hz = {settings.rate_hz:g}; change one "
                "of them"
            )
        counts = (page.counts_per_force / force, page.counts_per_torque / torque)
        for key, value in zip(("counts_per_force", "counts_per_torque"), counts, strict=True):
            wanted = getattr(settings, key)
            if wanted and abs(wanted - value) > 1e-6 * value:
                raise self._not_this(f"has {value:g} counts in an SI unit; the configuration says {key} = {wanted:g}")
        self._model = model
        if not settings.sample_hz:
            self._clock.state(page.sample_hz or rdt.SAMPLE_HZ)
        self._block.set_scale(1 / counts[0], 1 / counts[1])
        known = f"{page.product}, serial number {page.serial}, {page.rate_hz:g} records/s"
        if known != self._known:
            self._known = known
            self.kit.log("info", f"identified {self.name} on {self.line}: {known}")

    def _not_this(self, what: str) -> DeviceError:
        return DeviceError(errno.ENODEV, f"identify {self.name} at {self._page_host}: the sensor {what}")


def _page_host(settings: AtiRdtSettings) -> str:
    return settings.page or (settings.line.udp or "").rpartition(":")[0] + ":80"


def _check(settings: AtiRdtSettings) -> None:
    if settings.line.udp is None:
        raise ValueError('line: RDT is UDP; want line = { udp = "host:49152" }')
    if split_address(settings.line.udp)[1] == 0:
        raise ValueError(f"line.udp = {settings.line.udp}: requests need a port; want 49152")
    if not 1 <= settings.rate_hz <= 20_000:
        raise ValueError(f"rate_hz = {settings.rate_hz:g}; want 1 to 20000")
    if settings.sample_hz and not 1 <= settings.sample_hz <= 20_000:
        raise ValueError(f"sample_hz = {settings.sample_hz:g}; want 1 to 20000, or nothing")
    for key in ("counts_per_force", "counts_per_torque"):
        if not 0 <= getattr(settings, key) < 1e12:
            raise ValueError(f"{key} = {getattr(settings, key):g}; want a positive number")
        if settings.page == "none" and not getattr(settings, key):
            raise ValueError(f'{key}: none given; page = "none" needs it, from the calibration sheet')
    if settings.page == "none" and (not settings.model or settings.serial_number):
        raise ValueError('page = "none": want model = "net" or "axia", and no serial_number, which RDT does not tell')
    if settings.page != "none":
        LineSettings(tcp=_page_host(settings))
