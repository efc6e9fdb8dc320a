"""The name table: which node names exist, and which channels of which device each one shows. Pure.

Names are views; ownership is kept on channels. So a bit and its byte, an axis and its group, and two
names of one thing exclude each other without any rule of their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from sioms.protocol.flags import PROTOCOL_VERSION, READONLY, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.wording import did_you_mean

from .config import NodeTable


@dataclass(frozen=True, slots=True)
class BlockInfo:
    """A block as the fork server described it."""

    name: str
    node_class: NodeClass
    channels: tuple[ChannelInfo, ...]
    writable: bool
    history: int
    capacity: int


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """A device as the fork server described it."""

    name: str
    driver: str
    blocks: tuple[BlockInfo, ...]
    tick_hz: float
    inputs: tuple[str, ...]
    lease_s: float
    claims: tuple[str, ...] = ()
    made_of: str = ""
    """A digest of the driver's file and of those that its table names."""
    kind: str = "tick"
    """Of its driver: compiled, tick, line or stream; see needs.py."""
    realtime_priority: int = 0
    """That its driver asks for unless the configuration says otherwise; 0: none."""
    holds: tuple[str, ...] = ()
    """Axis nodes of other devices that are this one's own; they are among ``inputs``, too."""

    def facts(self) -> list[object]:
        """Return all it tells as plain values, to be compared."""
        blocks = [
            [
                b.name,
                b.node_class,
                [channel.pack() for channel in b.channels],
                b.writable,
                b.history,
                b.capacity,
            ]
            for b in self.blocks
        ]
        return [self.driver, blocks, self.tick_hz, self.inputs, self.lease_s, self.made_of, self.holds]

    @classmethod
    def unpack(cls, name: str, driver: str, packed: list) -> DeviceInfo:  # type: ignore[type-arg]
        """Make it from the fork server's reply."""
        blocks, tick_hz, inputs, lease_s, claims, made_of, kind, realtime_priority, holds = packed
        return cls(
            name,
            driver,
            tuple(
                BlockInfo(n, NodeClass(c), tuple(ChannelInfo(*ch) for ch in chs), w, history, capacity)
                for n, c, chs, w, history, capacity in blocks
            ),
            tick_hz,
            tuple(inputs),
            lease_s,
            tuple(claims),
            made_of,
            kind,
            realtime_priority,
            tuple(holds),
        )


def part_name(device: DeviceInfo, block: int, channel: int, bit: int) -> str:
    """Return the name of the node that shows one channel of a device, or one bit of it (-1: all)."""
    info = device.blocks[block]
    name = f"{device.name}.{info.name}" if info.name else device.name
    if len(info.channels) > 1 or info.node_class is not NodeClass.BINARY:
        name += f".{info.channels[channel].name}"
    return name if bit < 0 else f"{name}.bit{bit}"


def shared_claims(devices: Iterable[DeviceInfo]) -> list[str]:
    """Return a sentence for each device that wants what one before it has already: a port, a unit, a line."""
    errors, owners = [], dict[str, str]()
    for device in devices:
        for claim in device.claims:
            # A whole network address is in the way of its units.
            there = [
                claim,
                claim.partition(" unit ")[0],
                *(c for c in owners if c.startswith(f"{claim} unit ")),
            ]
            owner = next((owners[each] for each in there if each in owners), None)
            if owner is not None:
                errors.append(f"[device.{device.name}]: {claim} is already used by device {owner}; want another")
                break
        owners |= dict.fromkeys(device.claims, device.name)
    return errors


Claim = tuple[str, int, int, int]
"""(device, block, channel, bit): a piece of an output; bit -1 is the whole channel."""


@dataclass(frozen=True, slots=True)
class Node:
    """One name and what it shows."""

    name: str
    device: str
    block: int
    channels: tuple[int, ...]
    bit: int
    read_only: bool

    def claims(self) -> list[Claim]:
        """Return what an open of this node owns: nothing for a read-only one."""
        return [] if self.read_only else [(self.device, self.block, channel, self.bit) for channel in self.channels]


def shows(node: Node, part: Node) -> bool:
    """Whether a node shows all that another one, of one channel or bit, shows."""
    return (
        (node.device, node.block) == (part.device, part.block)
        and set(part.channels) <= set(node.channels) and node.bit in (-1, part.bit)
    )  # fmt: skip


class NameTable:
    """All names of a workcell.

    Attributes:
        nodes: by name, in the order of the configuration.
        devices: descriptions by device name.
        holders: the device that has a channel (device, block, channel) as its own.
        errors: sentences about aliases and inputs that name nothing, and devices that cannot be made of devices so.
    """

    def __init__(self, devices: Mapping[str, DeviceInfo], aliases: Mapping[str, NodeTable]) -> None:
        self.devices = dict(devices)
        self.nodes: dict[str, Node] = {}
        self.errors: list[str] = []
        for device in devices.values():
            for index, block in enumerate(device.blocks):
                base = device.name if not block.name else f"{device.name}.{block.name}"
                everything = tuple(range(len(block.channels)))
                self._add(
                    Node(base, device.name, index, everything, -1, not block.writable),
                    f"[device.{device.name}]",
                )
        for name, alias in aliases.items():
            self._alias(name, alias)
        for device in devices.values():
            for wanted in device.inputs:
                if wanted not in self.nodes:
                    self.errors.append(
                        f"[device.{device.name}]: reads node {wanted}, which does not "
                        f"exist{did_you_mean(wanted, self.nodes)}"
                    )
        self.holders: dict[tuple[str, int, int], str] = {}
        for device in devices.values():
            self.errors += [f"[device.{device.name}]: {error}" for error in self._hold(device)]

    def _hold(self, device: DeviceInfo) -> Iterator[str]:
        """Note what a device holds; yield a sentence for each node that it cannot."""
        for name in device.holds:
            node = self.nodes.get(name)
            if node is None:
                continue  # told as an input
            if node.read_only or self.block(node).node_class is not NodeClass.AXIS:
                yield f"holds node {name}, which takes no motion commands; want a node of axes"
            elif device.name in self.made_of(node.device):
                yield f"holds node {name} of device {node.device}, which is made of this one; want no ring of devices"
            else:
                for claim in node.claims():
                    owner = self.holders.setdefault(claim[:3], device.name)
                    if owner != device.name:
                        axis = self.block(node).channels[claim[2]].name
                        yield f"holds axis {axis} of node {name}, which device {owner} holds; want one holder an axis"
                        break

    def made_of(self, device: str) -> set[str]:
        """Return a device, and all whose axes it holds, directly or not."""
        found, new = {device}, [device]
        while new:
            info = self.devices.get(new.pop())
            targets = {self.nodes[name].device for name in info.holds if name in self.nodes} if info else set()
            new += targets - found
            found |= targets
        return found

    def holder(self, node: Node) -> str:
        """Return the device to which an axis of this node belongs by the configuration, '' where none does."""
        return next((owner for c in node.claims() if (owner := self.holders.get(c[:3]))), "")

    def block(self, node: Node) -> BlockInfo:
        """Return the block a node shows."""
        return self.devices[node.device].blocks[node.block]

    def pack(self, node: Node) -> list[object]:
        """Return a node's information in wire form (see NodeInfo)."""
        device, block = self.devices[node.device], self.block(node)
        channels = [block.channels[i].pack() for i in node.channels]
        if node.bit >= 0:
            channels = [[f"bit{node.bit}", "", 0, 1, 1, 0, {}, ""]]
        return [
            node.name, int(block.node_class), node.read_only, channels, node.bit, device.tick_hz,
            block.capacity, node.device, device.driver, PROTOCOL_VERSION,
        ]  # fmt: skip

    def _add(self, node: Node, where: str) -> None:
        for each in self._companions(node):
            if each.name in self.nodes:
                self.errors.append(
                    f"{where}: node name {each.name} is already taken by device {self.nodes[each.name].device}"
                )
            else:
                self.nodes[each.name] = each

    def _companions(self, node: Node) -> Iterator[Node]:
        """Yield the node, its parts, and the read-only companion of each that can be written."""
        for each in self._parts(node):
            yield each
            if not each.read_only:
                yield replace(each, name=each.name + READONLY, read_only=True)

    def _parts(self, node: Node) -> Iterator[Node]:
        yield node
        block = self.block(node)
        ports = block.node_class is NodeClass.BINARY
        if len(node.channels) > 1 or (len(block.channels) == 1 and not ports):
            for channel in node.channels:
                part = replace(node, name=f"{node.name}.{block.channels[channel].name}", channels=(channel,))
                yield part
                yield from self._bits(part, block)
        else:
            yield from self._bits(node, block)

    def _bits(self, node: Node, block: BlockInfo) -> Iterator[Node]:
        width = block.channels[node.channels[0]].width
        if node.bit < 0 and width > 1:
            for bit in range(width):
                yield replace(node, name=f"{node.name}.bit{bit}", bit=bit)

    def _alias(self, name: str, alias: NodeTable) -> None:
        where = f"[node.{name}]"
        target = self.nodes.get(alias.of)
        if target is None:
            self.errors.append(f"{where}: of = {alias.of}, which does not exist{did_you_mean(alias.of, self.nodes)}")
            return
        channels = target.channels
        if alias.channels:
            names = {self.block(target).channels[i].name: i for i in target.channels}
            wrong = [c for c in alias.channels if c not in names]
            if wrong:
                self.errors.append(f"{where}: {alias.of} has no channel {wrong[0]}{did_you_mean(wrong[0], names)}")
                return
            if len(set(alias.channels)) < len(alias.channels):
                self.errors.append(f"{where}: a channel is named twice in {alias.channels}")
                return
            channels = tuple(names[c] for c in alias.channels)
        self._add(replace(target, name=name, channels=channels), where)
