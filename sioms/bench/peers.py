"""Control systems of others that are installed here, beside this one, in one run and on one core.

Each has a server process with one number and a client that reads it and writes it with an acknowledgement: EPICS PV
Access (p4p), EPICS Channel Access (caproto), Tango (pytango). None is needed: those that are not installed are left
out. A read of theirs asks the server, one of ours copies out of shared memory; a write of ours commands an axis.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, NamedTuple

from sioms.check.daemon import Daemon
from sioms.children import ends_with_us
from sioms.client.command import command

from .baseline import RoundTrip
from .figures import Report
from .options import Options
from .workcells import axes, workcell

CHUNK = 20
PACE_S = 0.01
_PVA = """
import json, sys, threading
from p4p.nt import NTScalar
from p4p.server import Server
from p4p.server.thread import SharedPV
class Put:
    def put(self, pv, operation):
        pv.post(operation.value())
        operation.done()
pv = SharedPV(nt=NTScalar("d"), initial=0.0, handler=Put())
with Server(providers=[{"bench:x": pv}], isolate=True) as server:
    print(json.dumps(server.conf()), flush=True)
    threading.Event().wait()
"""
_CA = """
from caproto.server import PVGroup, pvproperty, run
class Ioc(PVGroup):
    x = pvproperty(value=0.0, name="x")
print("ready", flush=True)
run(Ioc(prefix="bench:").pvdb, interfaces=["127.0.0.1"], log_pv_names=False)
"""


class Calls(NamedTuple):
    """A read and a write of a number with its acknowledgement."""

    read: Callable[[], object]
    write: Callable[[float], object]


def bench_peers(options: Options, report: Report) -> None:
    """Reads and writes of each, in turn with the others and with a bare round trip."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})  # and so are all servers
    try:
        with ExitStack() as stack:
            _measure(options, report, _started(stack, report))
    finally:
        os.sched_setaffinity(0, before)


def _started(stack: ExitStack, report: Report) -> dict[str, Calls]:
    found = {}
    for name, (module, peer) in PEERS.items():
        if module and importlib.util.find_spec(module) is None:
            report.note(f"{name}: not installed, left out")
            continue
        try:
            found[name] = stack.enter_context(peer())
        except Exception as error:  # whatever a foreign system does at its start is told, not suffered
            report.note(f"{name}: left out: {type(error).__name__}: {error}")
    return found


def _measure(options: Options, report: Report, found: dict[str, Calls]) -> None:
    count, paced = options.count(100, 2000), options.count(50, 500)
    size = len(command(0, position=0.0))
    with RoundTrip() as bare:
        acts: dict[str, Callable[[float], object]] = {"bare round trip": lambda _: bare.once(size)}
        acts |= {f"read, {name}": _reading(calls.read) for name, calls in found.items()}
        acts |= {f"acknowledged write, {name}": calls.write for name, calls in found.items()}
        taken: dict[str, list[int]] = {name: [] for name in acts}
        while len(taken["bare round trip"]) < count:
            for name, act in acts.items():
                taken[name] += [_timed(act, i) for i in range(CHUNK)]
            report.progress(f"peers: {len(taken['bare round trip'])} of {count}")
        seldom = {name: act for name, act in acts.items() if not name.startswith("read")}
        slow: dict[str, list[int]] = {name: [] for name in seldom}
        for i in range(paced):
            for name, act in seldom.items():
                time.sleep(PACE_S)
                slow[name].append(_timed(act, i))
    for samples, how in ((taken, ""), (slow, ", one in 10 ms")):
        base = report.samples(f"bare round trip{how}", samples["bare round trip"])
        for name in list(samples)[1:]:
            report.samples(name + how, samples[name], baseline=base)


def _reading(read: Callable[[], object]) -> Callable[[float], object]:
    return lambda _: read()


def _timed(act: Callable[[float], object], i: int) -> int:
    value = 0.001 * (i % 2)
    begin = time.perf_counter_ns()
    act(value)
    return time.perf_counter_ns() - begin


@contextmanager
def _server(text: str, environment: dict[str, str]) -> Iterator[str]:
    """Run a server; yield the first line that it prints."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", text], env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True,
        preexec_fn=ends_with_us(),
    )  # fmt: skip
    try:
        yield process.stdout.readline() if process.stdout is not None else ""
    finally:
        process.kill()
        process.wait()


@contextmanager
def _sioms() -> Iterator[Calls]:
    with Daemon(workcell([axes("mod0")])) as daemon, daemon.cell() as cell, cell.open("mod0", "rw") as node:
        yield Calls(lambda: node.read().position[0], lambda x: node.write(command(0, position=x), replace=True))


@contextmanager
def _pva() -> Iterator[Calls]:
    from p4p.client.thread import Context

    with _server(_PVA, {}) as told, Context("pva", conf=json.loads(told), useenv=False) as client:
        yield Calls(lambda: client.get("bench:x", timeout=5.0), lambda x: client.put("bench:x", x, timeout=5.0))


@contextmanager
def _ca() -> Iterator[Calls]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    place = {"EPICS_CA_SERVER_PORT": port, "EPICS_CA_ADDR_LIST": "127.0.0.1", "EPICS_CA_AUTO_ADDR_LIST": "NO"}
    os.environ.update(place)
    client_of: Any = importlib.import_module("caproto.threading.client")
    with _server(_CA, {}):
        context = client_of.Context(client_of.SharedBroadcaster())
        (pv,) = context.get_pvs("bench:x", timeout=10.0)
        pv.wait_for_connection(timeout=20.0)
        try:
            yield Calls(lambda: pv.read(timeout=5.0).data[0], lambda x: pv.write([x], wait=True, timeout=5.0))
        finally:
            context.disconnect()


@contextmanager
def _tango() -> Iterator[Calls]:
    tango: Any = importlib.import_module("tango")
    server: Any = importlib.import_module("tango.server")
    testing: Any = importlib.import_module("tango.test_context")

    class Bench(server.Device):  # type: ignore[misc]
        """One number."""

        value = 0.0

        def read_x(self) -> float:
            """Return it."""
            return self.value

        def write_x(self, value: float) -> None:
            """Change it."""
            self.value = value

        x = server.attribute(dtype=float, access=tango.AttrWriteType.READ_WRITE, fget=read_x, fset=write_x)

    with testing.DeviceTestContext(Bench, process=True) as proxy:
        yield Calls(lambda: proxy.read_attribute("x").value, lambda x: proxy.write_attribute("x", x))


PEERS: dict[str, tuple[str, Callable[[], AbstractContextManager[Calls]]]] = {
    "SIOMS": ("", _sioms),
    "EPICS PV Access (p4p)": ("p4p", _pva),
    "EPICS Channel Access (caproto)": ("caproto", _ca),
    "Tango (pytango)": ("tango", _tango),
}
"""Name of a system: the module that it needs, and its server and client."""
