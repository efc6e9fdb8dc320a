"""An ATI Net F/T box or Ethernet Axia on UDP, with its web page: ``python -m sioms.drivers.ati_rdt.simulator --port
0``.

RDT on a UDP port, ``/netftapi2.xml`` on the TCP port of the same number. It answers requests with records to where they
came from, and to the last client alone; streams for ever when nobody stops it; sets its zero on request without an
answer; reports saturation in its model's status word; counts its samples at ``--internal-hz``, which its page tells as
``runrate`` (Net) or ``setrate`` (Axia), and repeats a sample when records are
faster. Its zero goes with its power, its settings stay. Commands on standard input: ``load FX FY FZ TX TY TZ
[SECONDS]``, ``status WORD`` (or-ed to its own, 0 = none), ``stall``, ``resume`` (samples go on, records do not leave),
``page ELEMENT VALUE``, ``web on|off``, ``garbage SIZE``, ``state``, ``power_cycle [SECONDS]``, ``freeze [COUNT]``,
``hold on|off`` (records are numbered on, their sample stands still), ``foreign zero|client|units|rate VALUE``, and the
faults of a network: ``mute COUNT`` (drop), ``double``, ``late SECONDS COUNT``, ``cut``, ``deaf COUNT`` (requests lost).
"""

from __future__ import annotations

import argparse
import asyncio
import struct
import time
from collections.abc import Callable

from sioms.simulation.control import number, serve
from sioms.simulation.faults import Faults
from sioms.simulation.load import Load
from sioms.simulation.supply import Standstill, Supply
from sioms.simulation.udp import Address, UdpPort, missed, stream

MAX_COUNT = 2**32
SATURATED = {"net": 0x80020000, "axia": 0xC0000000}
RATES = {"net": "runrate", "axia": "setrate"}
PRODUCTS = {"net": "Net F/T", "axia": "ETHERNET AXIA"}


class Sensor:
    """The sensor without its ports; times in seconds of the given clock."""

    def __init__(self, options: argparse.Namespace, clock: Callable[[], float] = time.monotonic) -> None:
        self.options, self.clock = options, clock
        self.load = Load(options.range_n, options.range_nm)
        self.extra_status = 0
        self.stalled = False
        self.page = {
            "prodname": PRODUCTS[options.model],
            "setserial": options.serial,
            "cfgcpf": str(options.counts_per_force),
            "cfgcpt": str(options.counts_per_torque),
            "scfgfu": options.force_unit,
            "scfgtu": options.torque_unit,
            "comrdtrate": str(options.rate),
            "setbias": "0;0;0;0;0;0",
            RATES[options.model]: str(round(options.internal_hz)),
        }
        if options.no_rate:
            del self.page[RATES[options.model]]
        self.supply, self.standstill = Supply(clock, self.boot, options.boot_s), Standstill()
        self.held_s = 0.0
        self.boot(clock())

    def boot(self, at_s: float) -> None:
        """Begin anew, as after its power came back: no stream, no zero of its own, samples counted from 0."""
        self.born_s = at_s
        self.page["setbias"] = "0;0;0;0;0;0"
        self.host: Address | None = None
        self.next_s = 0.0
        self.sequence = 0
        self.left = 0
        self.per_datagram = 1
        self.pending: list[bytes] = []
        self.load.zero(None)

    def take(self, data: bytes, sender: Address) -> None:
        """Obey a request."""
        if len(data) != 8 or not self.supply.is_on:
            return
        head, command, count = struct.unpack(">HHI", data)
        if head != 0x1234:
            return
        match command:
            case 0:
                self.host, self.next_s, self.pending = None, 0.0, []
            case 2 | 3:
                self.host, self.next_s = sender, self.clock()
                self.sequence, self.left = 0, count or MAX_COUNT
                self.per_datagram, self.pending = self.options.buffer if command == 3 else 1, []
            case 0x41:
                self.extra_status &= ~0x10000
            case 0x42:
                self.zero()

    def zero(self) -> None:
        """Take the present load as zero."""
        now_s = self.clock()
        self.load.zero(now_s)
        counts = [round(value * each) for value, each in zip(self.load.true(now_s), self._scale(), strict=True)]
        self.page["setbias"] = ";".join(map(str, counts))

    def _scale(self) -> list[float]:
        options = self.options
        return [options.counts_per_force / options.newton] * 3 + [options.counts_per_torque / options.newton_metre] * 3

    def due(self, send: Callable[[bytes, Address], None]) -> None:
        """Send the records sampled until now."""
        if not self.supply.is_on:
            return
        now_s, period_s = self.clock(), 1 / self.options.rate
        if self.next_s:
            count = missed(self.next_s, now_s, self.options.rate)
            self.next_s += count * period_s
            self.sequence = (self.sequence + count) % MAX_COUNT
        while self.host is not None and self.next_s <= now_s:
            self.pending.append(self._record(self.next_s))
            self.next_s += period_s
            self.left -= 1
            if len(self.pending) >= self.per_datagram or not self.left:
                if not self.stalled:
                    send(self.standstill.bend(b"".join(self.pending)), self.host)
                self.pending = []
            if not self.left:
                self.host, self.next_s = None, 0.0

    def _record(self, at_s: float) -> bytes:
        options = self.options
        at_s = self.held_s or at_s
        values, clipped = self.load.measured(at_s)
        status = self.extra_status | (SATURATED[options.model] if clipped else 0)
        samples = int((at_s - self.born_s) * options.internal_hz * (1 + options.clock_ppm * 1e-6))
        self.sequence = (self.sequence + 1) % MAX_COUNT
        counts = [round(value * each) for value, each in zip(values, self._scale(), strict=True)]
        return struct.pack(">III6i", self.sequence, samples % MAX_COUNT, status, *counts)

    def xml(self) -> str:
        """Return the page."""
        elements = "".join(f"<{name}>{value}</{name}>\r\n" for name, value in self.page.items())
        return (
            f'<?xml version="1.0" encoding="ISO-8859-1"?>\r\n<netft>\r\n<runstat>0</runstat>\r\n{elements}</netft>\r\n'
        )

    def state(self) -> dict[str, object]:
        """Return what a bystander sees."""
        return {
            "streaming": self.host is not None, "sequence": self.sequence, "buffered": self.per_datagram > 1,
            "load": self.load.true(self.clock()), "on": self.supply.is_on, "bias": self.page["setbias"],
        }  # fmt: skip

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def status(word: str) -> None:
            self.extra_status = int(number(word))

        def page(name: str, *words: str) -> None:
            self.page[name] = " ".join(words)

        def hold(word: str) -> None:
            self.held_s = self.clock() if word == "on" else 0.0

        def foreign(kind: str, value: str = "0") -> None:
            if kind == "zero":
                self.zero()
            elif kind == "client":
                self.host = ("127.0.0.1", 9)
            elif kind == "units":
                self.page["scfgfu"], self.options.newton = value, {"N": 1.0, "lbf": 4.4482216152605}[value]
            elif kind == "rate":
                self.options.rate, self.page["comrdtrate"] = float(value), value
            else:
                raise ValueError(f"{kind}; want one of zero, client, units, rate")

        def set_stall(value: bool) -> Callable[[], None]:
            return lambda: setattr(self, "stalled", value)

        return {
            **self.load.handlers(self.clock),
            "status": status,
            "stall": set_stall(True),
            "resume": set_stall(False),
            "page": page,
            "state": self.state,
            "power_cycle": self.supply.cycle,
            "freeze": self.standstill.set,
            "hold": hold,
            "foreign": foreign,
        }


class WebServer:
    """The sensor's web server: one page, one request a connection."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._server: asyncio.Server | None = None

    async def open(self, port: int) -> None:
        """Listen."""
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", port)

    def close(self) -> None:
        """Stop listening."""
        if self._server is not None:
            self._server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await reader.readuntil(b"\r\n\r\n")
            if not self._sensor.supply.is_on:
                await asyncio.sleep(10.0)
                return
            found = head.split(b" ")[1:2] == [b"/netftapi2.xml"]
            text = self._sensor.xml() if found else "<html>not found</html>"
            status = "200 OK" if found else "404 Not Found"
            writer.write(f"HTTP/1.0 {status}\r\nContent-Type: text/xml\r\n\r\n{text}".encode("latin-1"))
            await writer.drain()
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()


def options_parser() -> argparse.ArgumentParser:
    """Return the options."""
    parser = argparse.ArgumentParser(description="simulated ATI Net F/T or Ethernet Axia")
    parser.add_argument("--port", type=int, default=49152, help="of RDT and of the web page, 0 = a free one")
    parser.add_argument("--model", choices=PRODUCTS, default="net")
    parser.add_argument("--serial", default="FT12345")
    parser.add_argument("--rate", type=float, default=1000, help="records a second")
    parser.add_argument("--buffer", type=int, default=10, help="records in a buffered datagram")
    parser.add_argument("--internal-hz", type=float, default=7000)
    parser.add_argument("--no-rate", action="store_true", help="do not tell the internal rate on the page")
    parser.add_argument("--boot-s", type=float, default=0.0, help="from power to readiness")
    parser.add_argument("--clock-ppm", type=float, default=40.0)
    parser.add_argument("--counts-per-force", type=int, default=1000000)
    parser.add_argument("--counts-per-torque", type=int, default=1000000)
    parser.add_argument("--force-unit", default="N")
    parser.add_argument("--torque-unit", default="Nm")
    parser.add_argument("--newton", type=float, default=1.0, help="newtons in the unit of force")
    parser.add_argument("--newton-metre", type=float, default=1.0, help="newton metres in the unit of torque")
    parser.add_argument("--range-n", type=float, default=400.0)
    parser.add_argument("--range-nm", type=float, default=20.0)
    return parser


async def run() -> None:
    """Serve until told to end."""
    options = options_parser().parse_args()
    sensor, faults = Sensor(options), Faults()
    port, web = UdpPort(faults, sensor.take), WebServer(sensor)
    await port.open(options.port)
    web_port = int(port.name.rpartition(":")[2])
    await web.open(web_port)
    loop = asyncio.get_running_loop()
    tasks = {loop.create_task(stream(lambda: sensor.due(port.send), lambda: sensor.next_s, sensor.clock))}

    def set_web(word: str) -> None:
        if word == "off":
            web.close()
        else:
            tasks.add(loop.create_task(web.open(web_port)))

    def garbage(size: str) -> None:
        if sensor.host is not None:
            port.garbage(int(size), sensor.host)

    async def close() -> None:
        for task in tasks:
            task.cancel()
        web.close()
        port.close()

    handlers = {
        **faults.handlers(),
        **sensor.handlers(),
        "web": set_web,
        "garbage": garbage,
        "sent": lambda: port.sent,
    }
    await serve(port.name, handlers, close)


if __name__ == "__main__":
    asyncio.run(run())
