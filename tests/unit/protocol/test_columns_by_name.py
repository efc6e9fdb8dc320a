"""Columns are known by name: with further columns in every table of the records, all who read or write still find
theirs.

The tables are changed in a copy of ``records.py`` in a process of its own, before anything else is imported.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TREE = Path(__file__).parents[3]

WITH_MORE_COLUMNS = """
import importlib.util, re, sys
import sioms.protocol.flags

spec = importlib.util.find_spec("sioms.protocol.records")
text = open(spec.origin).read()
# A real and a whole number before the first, one behind the second and one behind the last column of each table.
tables = text.split("class AxisWrite:")[1].split("def columns(")[0]
heads = re.findall(r"(?m)^class \\w+:", text)[1:]
made = ""
for table in re.split(r"(?m)^(?=class )", "class AxisWrite:" + tables):
    if table.startswith("class "):
        lines = re.split(r"(?m)^(?=    \\w+: (?:int|float) = )", table)
        more = '    more%d: int = _whole("more")\\n    other%d: float = _real("", "other")\\n'
        lines.insert(1, more % (0, 0))
        lines.insert(3, more % (1, 1))
        lines[-1] = lines[-1].rstrip() + "\\n" + more % (2, 2) + "\\n\\n"
        table = "".join(lines)
    made += table
text = text.replace("class AxisWrite:" + tables, made)
module = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = module
exec(compile(text, spec.origin, "exec"), module.__dict__)
sioms.protocol.records = module
from sioms.protocol.flags import NodeClass
assert len(module.READ[NodeClass.AXIS]) == 19 and len(module.WRITE[NodeClass.BINARY]) == 10
assert list(module.READ[NodeClass.ANALOG])[:4] == ["more0", "other0", "data", "more1"], module.READ
"""

READ_AND_WRITE = """
import numpy as np
from motion_rig import AxisBank, AxisSettings, DriveBank, Markers, TICK_NS
from sioms.client.command import command
from sioms.client.snapshot import SNAPSHOT, Layout
from sioms.protocol.flags import AnalogStatus, PageState
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.protocol.page import PageReader, PageWriter, page_size
from sioms.protocol.records import VALUE, WRITE_STRUCT, numpy_dtype
from sioms.sdk.blocks import AnalogBlock, BinaryBlock, BlockSpec
from sioms.tools.columns import Columns
from sioms.tools.options import Target
from sioms.tools.rows import Rows

def seen(node_class, n, payload):
    page = bytearray(page_size(node_class, n, 4))
    writer = PageWriter(memoryview(page), node_class, n, 4, 10**9, 1)
    writer.publish(payload, 5, 1, 1)
    writer.alive(5)
    writer.set_state(PageState.GOOD, "")
    return SNAPSHOT[node_class](PageReader(page).latest(5), Layout(node_class, n, list(range(n)), -1))

# A short write, a long one, and what devout makes of numbers move a servo that follows at once.
limits = dict(velocity_max=1.0, acceleration_max=10.0, position_min=-1.0, position_max=1.0)
settings = [AxisSettings("x", k=1.0, force_max=50.0, **limits), AxisSettings("y", k=2.0, kz=3.0, force_max=50.0, **limits)]
bank = AxisBank(settings, tick_s=1e-3, markers=Markers())
info = NodeInfo(["m", 3, False, [ChannelInfo(c, "m", -1.0, 1.0, 0, 0x3F, {}).pack() for c in "xy"], -1, 1e3, 64, "m", "d", 1])
numbers = Columns(Target("m", dict.fromkeys("pt", 0.0)), info)
words = [command(0, position=0.1), command(1, position=0.2, max_velocity=0.5, max_acceleration=2.0), numbers.records([0.3, 2.0, 0.4, 2.0])]
now = 0
raw = np.zeros(2)
def run(ticks):
    global now
    for _ in range(ticks):
        now += TICK_NS
        bank.tick(now, raw)
        raw[:] = bank.rows["commanded_position"]
run(3)
short = list(WRITE_STRUCT[NodeClass.AXIS].iter_unpack(words[0] + words[1]))
assert bank.offer(short, [0, 1], now)
run(2000)
assert bank.is_idle([0, 1]) and np.allclose(bank.rows["position"], [0.1, 0.2]), bank.rows
bank.append(np.frombuffer(words[2], numpy_dtype(NodeClass.AXIS)), [0, 1], now)
run(1000)
assert not bank.is_idle([0, 1]) and (bank.rows["in_motion"] == 1).all()
run(1500)
snapshot = seen(NodeClass.AXIS, 2, bank.fields.data.cast("B"))
assert np.allclose(snapshot.position, [0.3, 0.4]) and snapshot.buffered == (0, 0) and snapshot.in_motion == (0, 0)
assert snapshot[1].k == 2.0 and snapshot[1].kz == 3.0 and snapshot[0].status == 0
assert Rows(Target("m", dict.fromkeys("pN", 0.0)), info).text(snapshot) == "0 3.0000e-01\\n1 4.0000e-01\\n"
assert "following error" in Rows(Target("m", dict.fromkeys("V", 0.0)), info).text(snapshot)

drive = DriveBank(settings[:1], markers=Markers())
still = np.zeros(1, dtype=bool)
drive.poll(1, np.array([0.25]), np.array([0.5]), still, ~still, force=np.array([4.0]))
reading = seen(NodeClass.AXIS, 1, drive.fields.data.cast("B"))[0]
assert (reading.position, reading.velocity, reading.force) == (0.25, 0.5, 4.0)

analog = AnalogBlock(BlockSpec("", NodeClass.ANALOG, (ChannelInfo("a", "V"),)))
analog.data[0], analog.flags[0] = 1.5, int(AnalogStatus.SATURATED)
shown = seen(NodeClass.ANALOG, 1, analog.payload())
assert shown.data == (1.5,) and shown.flags == (int(AnalogStatus.SATURATED),)
port = BinaryBlock(BlockSpec("", NodeClass.BINARY, (ChannelInfo("a", "", width=8),)))
port.set(0, 5, 77)
shown = seen(NodeClass.BINARY, 1, port.payload())
assert shown.data == (5,) and shown[0].changed_ns == 77 and shown.edges == (1,)
"""  # noqa: E501


def test_a_further_column_shifts_nothing():
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, 'tests')\n{WITH_MORE_COLUMNS}{READ_AND_WRITE}"],
        cwd=TREE, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
