"""What is written to and read from files of nodes."""

from __future__ import annotations

import errno
from struct import pack
from typing import Any

import pytest
from daemon_rig import raises

from sioms.bridges.mount import lines
from sioms.bridges.mount.tree import Tree
from sioms.client.cell_verbs import NodeEntry
from sioms.client.command import command
from sioms.client.snapshot import SNAPSHOT, Layout
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.protocol.records import ANALOG_WRITE, BINARY_WRITE


def info(node_class: NodeClass, *names: str) -> NodeInfo:
    channels = [ChannelInfo(name, "m").pack() for name in names]
    return NodeInfo(["mod0", int(node_class), False, channels, -1, 1000.0, 16, "mod0", "sim-axes", 2])


ARM = info(NodeClass.AXIS, "xaxis", "yaxis")


def entry(name: str, node_class: NodeClass = NodeClass.AXIS, read_only: bool = False) -> NodeEntry:
    return NodeEntry([name, int(node_class), 1, read_only, name.split(".", maxsplit=1)[0], "up", "", -1])


def test_nodes_are_files_and_those_with_parts_are_folders_beside_one() -> None:
    tree = Tree([entry("mod0"), entry("mod0.xaxis"), entry("mod0.xaxis.readonly"), entry("beam0", read_only=True)])
    assert tree.folder("/") == ["beam0", "beam0.bin", "mod0", "mod0.all", "mod0.all.bin"]
    assert tree.folder("/mod0") == ["xaxis", "xaxis.bin"] and tree.folder("/beam0") is None
    whole, beam = tree.place("/mod0.all.bin"), tree.place("/beam0")
    assert whole is not None and (whole.name, whole.binary, whole.read_only) == ("mod0", True, False)
    assert beam is not None and (beam.name, beam.binary, beam.read_only) == ("beam0", False, True)
    for nothing in ("/mod0", "/mod0/zaxis", "/mod0.xaxis", "/mod0/xaxis.all", "/.bin", "/"):
        assert tree.place(nothing) is None, nothing


def test_names_that_are_no_paths_are_left_out() -> None:
    assert Tree([entry("a/b"), entry("..x"), entry("a..b"), entry("")]).folder("/") == []


@pytest.mark.parametrize(
    ("text", "records", "replace"),
    [
        ("0.1 0.2\n", command(0, position=0.1) + command(1, position=0.2), False),
        ("0.1, 0.2", command(0, position=0.1) + command(1, position=0.2), False),
        ("# away\nyaxis position=0.1 time=0.5  # there\n\n", command(1, position=0.1, time=0.5), False),
        ("0 velocity=1e-2 replace\n", command(0, velocity=0.01), True),
        ("1 position=1 relative synch wait=5 signal=1029\n",
         command(1, position=1, relative=True, synch=True, wait=5, signal=1029), False),
        ("1 2\nxaxis force=3\n", command(0, position=1) + command(1, position=2) + command(0, force=3), False),
    ],
)  # fmt: skip
def test_lines_become_records(text: str, records: bytes, replace: bool) -> None:
    assert lines.records(text, ARM) == (records, replace)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["no numbers", "2 numbers", "xaxis, yaxis"]),
        ("0.1\n", ["line 1", "1 numbers; want 2"]),
        ("0 0\nzaxis position=1\n", ["line 2", "no axis 'zaxis'", "xaxis, yaxis"]),
        ("position=1", ["no axis is named"]),
        ("xaxis position=fast", ["fast"]),
        ("xaxis speed=1", ["unknown word speed"]),
        ("xaxis position", ["WORD=NUMBER"]),
        ("xaxis position=1 position=2", ["'position' is given twice"]),
        ("replace", ["'replace' and nothing to do"]),
        ("xaxis time=1", ["no setpoint"]),
        ("xaxis position=1 wait=1.5", ["1.5"]),
        ("\0\xff", ["no axis"]),
    ],
)
def test_what_is_no_command_is_told_with_its_line(text: str, words: list[str]) -> None:
    with raises(errno.EINVAL, "write mod0", *words):
        lines.records(text, ARM)


@pytest.mark.parametrize("block", [512, 4096, 131072, 131072 - 24])
def test_the_last_line_of_a_block_waits_for_its_end(block: int) -> None:
    """As ``seq`` writes: 4096 bytes at a time, and the kernel no more than 128 KiB; a number is cut anywhere."""
    text = "".join(f"{0.1 + 1e-4 * i:.4f} 0\n" for i in range(20_000)).encode()
    rest, whole = b"", []
    for start in range(0, len(text), block):
        lines_, rest = lines.ended(rest, text[start : start + block])
        whole.append(lines.records(lines_.decode(), ARM)[0])
    assert rest == b"" and b"".join(whole) == lines.records(text.decode(), ARM)[0]


def test_a_short_write_needs_no_end() -> None:
    for text in (b"0.1", b"0.1\n0.2", b"velocity=0.2"):
        assert lines.ended(b"", text) == (text, b"")


def test_what_is_invalid_is_no_number() -> None:
    flags = int(AnalogStatus.INVALID | AnalogStatus.OVERRUN)
    snapshot: Any = SNAPSHOT[NodeClass.ANALOG](
        bytes(32) + pack("<2d2q", 1.5, 2.5, 0, flags), Layout(NodeClass.ANALOG, 2, [0, 1], -1)
    )
    assert lines.shown(snapshot, info(NodeClass.ANALOG, "a", "b")) == "0 1.5\n1 nan\n"


def test_outputs_take_values_and_bits() -> None:
    analog, port = info(NodeClass.ANALOG, "a", "b"), info(NodeClass.BINARY, "p")
    assert lines.records("1.5 -2", analog)[0] == ANALOG_WRITE.pack(0, 0, 1.5) + ANALOG_WRITE.pack(1, 0, -2.0)
    assert lines.records("255", port)[0] == BINARY_WRITE.pack(0, 0, 255, 0)
    for node, text in ((port, "1.5"), (port, "inf"), (port, "on"), (analog, "xaxis position=1 2")):
        with raises(errno.EINVAL):
            lines.records(text, node)


def test_binary_records_are_whole() -> None:
    records = command(0, position=0.1)
    assert lines.whole_records(records * 2, ARM) == records * 2
    for data in (b"", records[:-1], records + b"\0"):
        with raises(errno.EINVAL, f"{len(data)} bytes", "144"):
            lines.whole_records(data, ARM)


def test_a_snapshot_is_a_line_a_channel_or_its_readings() -> None:
    layout = Layout(NodeClass.BINARY, 2, [0, 1], -1)
    raw = bytes(32) + b"".join(value.to_bytes(8, "little") for value in (7, 0, 11, 12, 3, 4))
    snapshot: Any = SNAPSHOT[NodeClass.BINARY](raw, layout)
    ports = info(NodeClass.BINARY, "p", "q")
    assert lines.shown(snapshot, ports) == "0 7\n1 0\n"
    words = [int.from_bytes(lines.packed(snapshot, ports)[at : at + 8], "little") for at in range(0, 48, 8)]
    assert words == [7, 11, 3, 0, 12, 4] and len(words) * 8 == 2 * ports.read_struct_size
