"""The daemon's configuration: TOML text in, validated structs or a list of errors out. Pure.

The daemon validates what it reads itself; the rest of a device's table belongs to the driver and is
validated by the driver's ``Settings`` in the fork server, so that every device reports its own errors.
"""

from __future__ import annotations

import math
import os.path
import tomllib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from sioms.documents import DEEPEST
from sioms.protocol.flags import Reaction
from sioms.wording import choices, did_you_mean, every_error, explain, field_names

Table = TypeVar("Table", bound=msgspec.Struct)
RightName = Literal["read", "write", "stop", "administer"]
Count = Annotated[int, Meta(ge=1, le=65536)]
Seconds = Annotated[float, Meta(ge=0.05, le=3600.0)]


class WorkcellTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[workcell]``: the daemon itself."""

    name: str = "workcell"
    socket: str = ""
    socket_mode: Annotated[str, Meta(pattern="^0?[0-7]{3}$")] = "0660"
    socket_group: str = ""
    gateway_user: str = ""
    start_stopped: bool = False
    daemon_lease_s: Seconds = 0.5
    supervisor_lease_s: Annotated[float, Meta(ge=0.0, le=3600.0)] = 0.0
    max_sessions: Count = 256
    state_folder: str = ""


class QuotaTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[quota]``: how much one user may have at a time; root and the daemon's own user four times as much."""

    sessions: Count = 48
    silent: Count = 16
    greeting_s: Seconds = 5.0
    handles: Count = 256
    markers: Annotated[int, Meta(ge=1, le=1023)] = 128
    waits: Count = 256
    subscriptions: Count = 128


class GrantTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[grant]]``: rights of users, groups and keys on nodes; patterns as in the shell."""

    rights: list[RightName]
    users: list[str] = []
    groups: list[str] = []
    nodes: list[str] = msgspec.field(default_factory=lambda: ["*"])
    keys: list[str] = []


class DeviceTable(msgspec.Struct, frozen=True):
    """``[device.NAME]``: the keys the daemon reads; all others go to the driver."""

    driver: str
    description: str = ""
    on_loss: Literal["none", "stop"] = "none"
    realtime_priority: Annotated[int, Meta(ge=0, le=99)] | None = None
    hang_s: Seconds = 1.0
    lease_s: Seconds | None = None
    user: str = ""
    process: Annotated[str, Meta(pattern="^[A-Za-z0-9_.-]{0,32}$")] = ""


class NodeTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[node.NAME]``: another name, or a group of channels of one device."""

    of: str
    channels: list[str] = []
    description: str = ""


class StopSourceTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[emergency_stop]]``: a binary input that stops the workcell while it reads ``active``, or cannot be read."""

    node: str
    active: Literal[0, 1] = 0
    on_loss: Literal["stop", "none"] = "stop"


ReactionName = Literal["none", "stop_node", "stop_device", "stop_workcell"]


class AlarmTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[alarm]]``: limits of a column of the channels of a node, minor inside and major outside, or the state of a
    binary node; and what is stopped when they are reached, or cannot be judged.
    """

    node: str
    column: str = ""
    lolo: float | None = None
    low: float | None = None
    high: float | None = None
    hihi: float | None = None
    hysteresis: Annotated[float, Meta(ge=0)] = 0.0
    state: Literal[0, 1] | None = None
    severity: Literal["minor", "major"] = "major"
    on_minor: ReactionName = "none"
    on_major: ReactionName = "none"
    on_invalid: ReactionName | None = None

    def __post_init__(self) -> None:
        limits = [limit for limit in (self.lolo, self.low, self.high, self.hihi) if limit is not None]
        if self.state is not None and limits:
            raise ValueError("a state and limits; want state of a binary node, limits of any other")
        if not limits and self.state is None:
            raise ValueError("no limit given; want at least one of lolo, low, high, hihi, or state of a binary node")
        if limits != sorted(limits):
            given = ", ".join(f"{limit:g}" for limit in limits)
            raise ValueError(f"limits {given}; want lolo < low < high < hihi")

    def limits(self) -> list[float]:
        """Return lolo, low, high, hihi, infinite where there is none, and the hysteresis."""
        if self.state is not None:
            found: list[float] = [-math.inf, -math.inf, math.inf, math.inf]
            found[{(0, "major"): 0, (0, "minor"): 1, (1, "minor"): 2, (1, "major"): 3}[self.state, self.severity]] = (
                self.state
            )
            return [*found, 0.0]
        low = [-math.inf if limit is None else limit for limit in (self.lolo, self.low)]
        high = [math.inf if limit is None else limit for limit in (self.high, self.hihi)]
        return [*low, *high, self.hysteresis]

    def reactions(self) -> list[int]:
        """Return the Reaction to each severity: to what cannot be read that to a major alarm, unless it is told."""
        names = (self.on_minor, self.on_major, self.on_major if self.on_invalid is None else self.on_invalid)
        return [int(Reaction[name.upper()]) for name in names]


class Device(msgspec.Struct, frozen=True):
    """A configured device: the daemon's part and the driver's."""

    name: str
    common: DeviceTable
    settings: dict[str, Any]


class Config(msgspec.Struct, frozen=True):
    """A configuration without errors of its own (names are checked with the descriptions)."""

    workcell: WorkcellTable
    quota: QuotaTable
    devices: dict[str, Device]
    nodes: dict[str, NodeTable]
    grants: list[GrantTable]
    stop_sources: list[StopSourceTable]
    alarms: list[AlarmTable]
    folder: str

    def state_folder(self, environment: Mapping[str, str]) -> str:
        """Return where drivers keep what outlives them, '' when nowhere; systemd tells it in $STATE_DIRECTORY."""
        named = self.workcell.state_folder or environment.get("STATE_DIRECTORY", "").split(":")[0]
        return os.path.join(self.folder, named) if named else ""

    def process_of(self, device: str) -> str:
        """Return what is one for all devices of one process."""
        name = self.devices[device].common.process
        return f"process {name}" if name else f"device {device}"

    @property
    def processes(self) -> list[str]:
        """Return all that ``process_of`` returns, in the order of the devices."""
        return list(dict.fromkeys(map(self.process_of, self.devices)))


_SECTIONS = ("workcell", "quota", "device", "node", "grant", "emergency_stop", "alarm")
_COMMON = tuple(field.name for field in msgspec.structs.fields(DeviceTable))


@lru_cache(maxsize=1)
def _document(text: str) -> dict[str, Any]:
    """Return the tables of a document, which are not to be changed; a start looks into it twice."""
    return tomllib.loads(text)


def parse(text: str, folder: str) -> tuple[Config | None, list[str]]:
    """Read a configuration.

    Args:
        text: the TOML text.
        folder: where relative paths in it start.

    Returns:
        The configuration and the errors, one sentence each; None when there is nothing to go on with.
    """
    try:
        root = _document(text)
    except tomllib.TOMLDecodeError as error:
        from sioms.toml_errors import explained  # slow to import, and seldom needed

        return None, [explained(text, error)]
    except RecursionError:
        return None, [f"read configuration: arrays or tables nested too deep; want at most {DEEPEST} levels"]
    except ValueError as error:  # an integer of more digits than Python converts
        return None, [f"read configuration: {error}"]
    if {"family", "signals"} <= root.keys():
        text = 'this is a register map, not a configuration; refer to it from a device, map = "FILE"'
        return None, [text]
    errors = [f"[{key}]: unknown section{did_you_mean(key, _SECTIONS)}" for key in root if key not in _SECTIONS]
    workcell = _convert(root.get("workcell", {}), WorkcellTable, "[workcell]", errors) or WorkcellTable()
    quota = _convert(root.get("quota", {}), QuotaTable, "[quota]", errors) or QuotaTable()
    devices: dict[str, Device] = {}
    for name, table in _tables(root, "device", errors):
        device = _device(name, table, errors)
        if device is not None:
            devices[name] = device
    nodes = {}
    for name, table in _tables(root, "node", errors):
        node = _convert(table, NodeTable, f"[node.{name}]", errors)
        if node is not None:
            nodes[name] = node
        if name in devices:
            errors.append(f"[node.{name}]: a device already has this name; choose another")
    grants = _list(root, "grant", GrantTable, errors)
    sources = _list(root, "emergency_stop", StopSourceTable, errors)
    if not devices and not errors:
        errors.append("read configuration: no [device.NAME] in it; want at least one")
    alarms = _list(root, "alarm", AlarmTable, errors)
    return Config(workcell, quota, devices, nodes, grants, sources, alarms, folder), errors


def _tables(root: Mapping[str, Any], section: str, errors: list[str]) -> list[tuple[str, dict[str, Any]]]:
    found = root.get(section, {})
    if not isinstance(found, dict):
        errors.append(f"[{section}]: want tables [{section}.NAME]")
        return []
    good = []
    for name, table in found.items():
        if not isinstance(table, dict):
            errors.append(f"[{section}].{name}: want a table [{section}.{name}]")
        elif not _is_name(name) and section == "device":
            errors.append(f"[device.{name}]: not a device name; want letters, digits, - and _, beginning with a letter")
        elif section == "node" and not all(_is_name(part) for part in name.split(".")):
            errors.append(f"[node.{name}]: not a node name; want words of letters, digits, - and _, joined by dots")
        else:
            good.append((name, table))
    return good


def _list(root: Mapping[str, Any], section: str, kind: type[Table], errors: list[str]) -> list[Table]:
    found = root.get(section, [])
    if not isinstance(found, list):
        errors.append(f"[{section}]: want tables [[{section}]]")
        return []
    each = [_convert(table, kind, f"[[{section}]] number {i}", errors) for i, table in enumerate(found, 1)]
    return [table for table in each if table is not None]


def _is_name(name: str) -> bool:
    return (
        bool(name)
        and name[0].isascii()
        and name[0].isalpha()
        and all(c.isascii() and (c.isalnum() or c in "-_") for c in name)
        and name != "readonly"
    )


def _device(name: str, table: dict[str, Any], errors: list[str]) -> Device | None:
    where = f"[device.{name}]"
    strange = list(_strange(table, where))
    if strange:  # what no driver can be told
        errors += strange
        return None
    common = _convert({k: v for k, v in table.items() if k in _COMMON}, DeviceTable, where, errors)
    if common is None:
        if not isinstance(table.get("driver"), str):
            return None
        common = DeviceTable(table["driver"])  # so that its driver tells the other errors of the table
    return Device(name, common, {k: v for k, v in table.items() if k not in _COMMON})


def _strange(value: object, where: str, depth: int = 0) -> Iterator[str]:
    """Tell the values that no message to a driver can carry: dates and times, integers over 64 bits, deep nesting."""
    if isinstance(value, (dict, list)):
        if depth > DEEPEST:
            yield f"{where}: nested more than {DEEPEST} deep; no key of a device takes that"
            return
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _strange(each, f"{where}.{key}" if isinstance(value, dict) else f"{where}[{key}]", depth + 1)
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        yield f"{where}: an integer of more than 64 bits; no key of a device takes one"
    elif not isinstance(value, (str, int, float)):
        yield f"{where} = {value}: no key of a device takes a {type(value).__name__}"


def _convert(table: object, kind: type[Table], where: str, errors: list[str]) -> Table | None:
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        errors += every_error(where, table, kind) or [explain(where, error, field_names(kind), choices(kind))]
        return None
