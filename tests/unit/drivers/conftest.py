"""A kit for drivers without a daemon: the real marker table and the real shared pages, on one thread."""

import mmap
import os

import numpy as np
import pytest

from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.page import PageWriter, page_size
from sioms.protocol.records import read_rows
from sioms.sdk.blocks import AxisBlock
from sioms.sdk.inputs import Input
from sioms.sdk.markers import Markers


class Bench:
    """Runs drivers tick by tick and couples them through pages, as the daemon does."""

    def __init__(self):
        self.clock_ns = 1_000_000_000
        self.published = []
        self._shown = {}
        self.inputs = {}
        self.markers = Markers(MarkerTable(memoryview(bytearray(TABLE_SIZE))), lambda number: None)
        self._pages = []
        self._drivers = []
        self.halted = []
        """Drivers whose processes are stopped."""

    def now_ns(self):
        return self.clock_ns

    def log(self, level, text):
        raise AssertionError(f"{level}: {text}")

    def emergency_stop(self, source):
        raise AssertionError(source)

    def publish(self, block, stamp_ns):
        if block.spec.node_class is NodeClass.BINARY:
            self.published.append((int(block.data[0]), int(block.rows["changed_ns"][0])))
        self._publish(block, stamp_ns)

    def make(self, driver, name, table):
        """Make a driver from a configuration table and give its nodes to those made later."""
        import msgspec

        settings = msgspec.convert(table, driver.Settings)
        description = driver.describe(name, settings)
        for node in description.inputs:
            self.inputs.setdefault(node, Input(node))
        made = driver(name, settings, self)
        for block in made.blocks:
            self._page(name, block)
        self._drivers.append((made, round(1e9 / description.tick_hz)))
        return made

    def run(self, seconds, until=None):
        """Tick all drivers, in the order in which they were made."""
        period = min(period for _, period in self._drivers)
        for _ in range(round(seconds * 1e9 / period)):
            self.clock_ns += period
            for driver, own in self._drivers:
                if self.clock_ns % own == 0 and driver not in self.halted:
                    driver.tick(self.clock_ns)
                    for block in driver.blocks:
                        self._publish(block, self.clock_ns)
            if until is not None and until():
                return
        if until is not None:
            raise AssertionError(f"not within {seconds} s")

    def write(self, driver, **fields):
        """Append one command to a bank."""
        from sioms.protocol.records import NodeClass, numpy_dtype

        records = np.zeros(1, numpy_dtype(NodeClass.AXIS))
        for name, value in fields.items():
            records[name] = value
        driver.bank.append(records, np.arange(driver.bank.n), self.clock_ns)

    def _page(self, device, block):
        spec = block.spec
        size = page_size(spec.node_class, block.n, spec.history)
        fd = os.memfd_create("page")
        os.ftruncate(fd, size)
        writer = PageWriter(memoryview(mmap.mmap(fd, size)), spec.node_class, block.n, spec.history, 10**9, 1)
        writer.set_state(PageState.GOOD)
        self._pages.append((block, writer))
        base = ".".join(part for part in (device, spec.name) if part)
        for index, channel in enumerate(spec.channels):
            node = self.inputs.setdefault(f"{base}.{channel.name}", Input(f"{base}.{channel.name}"))
            node.attach(os.dup(fd), [index], -1)
        whole = self.inputs.setdefault(base, Input(base))
        whole.attach(os.dup(fd), list(range(block.n)), -1)
        os.close(fd)

    def _publish(self, block, stamp_ns):
        writer = next(writer for candidate, writer in self._pages if candidate is block)
        writer.alive(self.clock_ns)
        writer.publish(block.payload(), stamp_ns, 0, 0)
        fields = block.bank.fields if isinstance(block, AxisBlock) else block.fields
        first = {name: float(row[0]) for name, row in read_rows(block.spec.node_class, fields).items()}
        self._shown.setdefault(id(block), []).append((stamp_ns, first, fields.copy()))

    def shown(self, block, count=1000):
        """Return the last publications of a block: time stamp, and the columns of its first channel."""
        return [(stamp_ns, first) for stamp_ns, first, _ in self._shown[id(block)][-count:]]

    def forces(self, block):
        """Return the third component of all publications of a force sensor."""
        return [float(fields[0, 2]) for _, _, fields in self._shown[id(block)]]


@pytest.fixture
def bench():
    """Return a fresh bench."""
    return Bench()
