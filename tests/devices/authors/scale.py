"""A driver of one file: a weighing scale that answers ``W`` with its load, guarded by an xor."""

from __future__ import annotations

from typing import ClassVar

import msgspec

from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, BlockSpec, Description
from sioms.sdk.driver import LineDriver, LineUnit
from sioms.sdk.exchange import Exchange, LinkError
from sioms.sdk.golden import Golden
from sioms.sdk.settings import LineSettings


def xor(data: bytes) -> int:
    value = 0
    for byte in data:
        value ^= byte
    return value


def decode(reply: bytes) -> float:
    """Return the load of ``+0012.340*31``, CR LF [kg]."""
    text, star, check = reply.rstrip(b"\r\n").partition(b"*")
    try:
        if not star or int(check, 16) != xor(text) or reply[-2:] != b"\r\n" or len(check) != 2:
            raise ValueError
        return float(text)
    except ValueError:
        raise LinkError(f"read the load: {reply!r} is damaged") from None


def want(got: bytes) -> int | None:
    if len(got) > 40:
        raise LinkError(f"read the load: {len(got)} bytes without an end of line")
    end = got.find(b"\n")
    return end + 1 if end >= 0 else None


def load() -> Exchange:
    return Exchange(b"W\r", want, decode, 0.2, True, "read the load")


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    line: LineSettings
    poll_hz: float = 40.0


class ScaleUnit(LineUnit):
    def __init__(self, name: str, spec: BlockSpec) -> None:
        self.name = name
        self._block = AnalogBlock(spec)

    @property
    def blocks(self):
        return (self._block,)

    def open(self):
        yield load()

    def poll(self):
        self._block.data[0] = yield load()


class Scale(LineDriver):
    Settings = Settings
    rig: ClassVar = {
        "simulator": ["scale_device.py"],
        "tables": '[device.scale]\ndriver = "{driver}"\nline = { serial = "{port}", baud = 9600 }\n',
        "analogs": ["scale"],
    }

    @classmethod
    def describe(cls, name, settings):
        spec = BlockSpec("", NodeClass.ANALOG, (ChannelInfo("load", "kg", 0.0, 30.0),))
        return Description((spec,), settings.poll_hz)

    @classmethod
    def golden(cls, settings):
        return (Golden("load", load(), "57 0d", b"+0012.340*31\r\n".hex(), 12.34),)

    def __init__(self, name, settings, kit):
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._units = (ScaleUnit(name, self.describe(name, settings).blocks[0]),)

    @property
    def units(self):
        return self._units


DRIVER = Scale
