"""Finding drivers: by entry point in the group ``sioms.drivers``, or by the path of a file."""

from __future__ import annotations

import errno
import hashlib
import importlib.util
import math
import os
import stat
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from sioms.documents import MOST_BYTES, read_bytes
from sioms.protocol.flags import NodeClass
from sioms.protocol.page import page_size
from sioms.protocol.text import shown
from sioms.wording import choices, did_you_mean, every_error, explain, field_names

from .driver import Driver, LineDriver, StreamDriver, TickDriver
from .registry import Point, entry_points

GROUP = "sioms.drivers"
MOST_NUMBER = 1e15
"""Beyond it no number of a configuration measures anything, and squares of such numbers overflow."""


class DriverNotFound(Exception):
    """There is no such driver, or it cannot be imported; the text says which and why."""


@cache
def _registered() -> Mapping[str, Point]:
    return entry_points(GROUP)


def driver_names() -> list[str]:
    """Return the names of all registered drivers."""
    return sorted(_registered())


@cache
def find_driver(name: str, folder: str) -> type[Driver]:
    """Return a driver's class.

    Args:
        name: entry-point name, or the path of a Python file (with a slash or ending in .py) whose
            module has the class under the name ``DRIVER``.
        folder: where a relative path starts.

    Raises:
        DriverNotFound: with a sentence.
    """
    if "/" in name or name.endswith(".py"):
        return _from_file(os.path.join(folder, name))
    point = _registered().get(name)
    if point is None:
        raise DriverNotFound(f"driver = {name}: no such driver{did_you_mean(name, driver_names())}")
    try:
        return _checked(point.load(), name)
    except DriverNotFound:
        raise
    except Exception as error:  # whatever a foreign module does at import is reported, not suffered
        raise DriverNotFound(f"driver = {name}: import failed: {type(error).__name__}: {error}") from error


def _from_file(path: str) -> type[Driver]:
    stem = os.path.splitext(os.path.basename(path))[0].replace("-", "_")
    spec = importlib.util.spec_from_file_location(f"sioms_driver_{stem}", path)
    if spec is None or spec.loader is None or not os.path.isfile(path):
        raise DriverNotFound(f"driver = {path}: no such file; want a Python file that defines DRIVER")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where annotations that are still text are looked up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[spec.name]
        raise DriverNotFound(f"driver = {path}: import failed: {type(error).__name__}: {error}") from error
    if not hasattr(module, "DRIVER"):
        raise DriverNotFound(f"driver = {path}: it defines no DRIVER; set DRIVER to the driver's class")
    return _checked(module.DRIVER, path)


def _checked(found: object, name: str) -> type[Driver]:
    kinds = (TickDriver, LineDriver, StreamDriver)
    if not (isinstance(found, type) and issubclass(found, kinds)):
        raise DriverNotFound(f"driver = {name}: {found!r} is not a subclass of TickDriver, LineDriver or StreamDriver")
    return found


def read_settings(driver: type[Driver], table: Mapping[str, Any], folder: str) -> tuple[Any, list[str]]:
    """Validate a device's table.

    Args:
        driver: the driver's class.
        table: the keys of the device that the daemon does not read itself.
        folder: of the configuration, for settings that name files: a key ``..._file`` that is a
            relative path is taken from there, and so is a ``map`` that is a file.

    Returns:
        The settings (None with errors) and the errors, each beginning with ``.key`` or ``: ``.
    """
    kind = driver.Settings
    table = dict(_anchored(table, folder))
    odd = list(_odd_numbers(table))
    errors = list(odd)
    # The validator names one error; all are looked for only when there is one.
    top = kind.__struct_encode_fields__
    for key in [k for k in table if k not in top]:
        errors.append(f": unknown key {key}{did_you_mean(key, top)}")
        del table[key]
    try:
        return None if odd else msgspec.convert(table, kind), errors
    except msgspec.ValidationError as error:
        return None, errors + (every_error("", table, kind) or [explain("", error, field_names(kind), choices(kind))])


def _odd_numbers(value: Any, path: str = "") -> Iterator[str]:
    """Yield the numbers that measure nothing, in nested tables too: drivers compare with them, and NaN passes by."""
    if isinstance(value, Mapping | list):
        for key, each in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _odd_numbers(each, f"{path}[{key}]" if isinstance(value, list) else f"{path}.{key}")
    elif isinstance(value, float) and (math.isnan(value) or MOST_NUMBER < abs(value) < math.inf):
        yield f"{path}: {value:g}; want a number" + ("" if math.isnan(value) else f" of at most {MOST_NUMBER:g}")


def _anchored(value: Any, folder: str, key: str = "") -> Any:
    """Take the relative paths of keys ``..._file`` from a folder, in nested tables too."""
    if isinstance(value, Mapping):
        return {k: _anchored(v, folder, k) for k, v in value.items()}
    if isinstance(value, list):
        return [_anchored(v, folder) for v in value]
    if not isinstance(value, str) or not value:
        return value
    is_file = key.endswith("_file") or (key == "map" and value.endswith(".toml"))
    return os.path.join(folder, value) if is_file else value


def _named_files(value: Any, key: str = "") -> Iterator[str]:
    """The files that an anchored table names, in nested tables too."""
    if isinstance(value, Mapping):
        for k, each in value.items():
            yield from _named_files(each, k)
    elif isinstance(value, list):
        for each in value:
            yield from _named_files(each)
    elif isinstance(value, str) and (key.endswith("_file") or key == "map") and os.path.isfile(value):
        yield value


def missing_files(value: Any, folder: str) -> list[str]:
    """Return an error for each file that a table names and that cannot be read, each beginning with ``: ``.

    A driver may read its files not before it starts. A reload would then end the device that runs, for one that fails.

    Args:
        value: the table.
        folder: that relative paths are taken from.
    """
    errors = []
    for key, path in _keys_of_files(_anchored(value, folder)):
        try:
            with open(path, "rb", opener=_at_once) as file:
                if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                    raise OSError(errno.EINVAL, "it is no regular file")
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else str(error)
            errors.append(f": {key} = {shown(path)}: {why}; want a file that can be read")
    return errors


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe would hold up whoever waits for the answer


def _keys_of_files(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for k, each in value.items():
            yield from _keys_of_files(each, k)
    elif isinstance(value, list):
        for each in value:
            yield from _keys_of_files(each, key)
    elif isinstance(value, str) and value and (key.endswith("_file") or (key == "map" and value.endswith(".toml"))):
        yield key, value


def contents(driver: type[Driver], table: Mapping[str, Any], folder: str) -> str:
    """Return a digest of what a device is made of beside its table: the driver's file, and the files that its table
    names.

    A file of more than MOST_BYTES is known by its size and the time of its last change.
    """
    digest = hashlib.blake2b(digest_size=16)
    source = getattr(sys.modules.get(driver.__module__), "__file__", None)
    for path in [*([source] if source else []), *_named_files(_anchored(table, folder))]:
        try:
            about = os.stat(path)
            if about.st_size > MOST_BYTES:
                digest.update(f"{about.st_size} {about.st_mtime_ns}".encode())
            else:
                digest.update(read_bytes(Path(path)))
        except (OSError, ValueError) as error:  # who reads it will say so
            digest.update(type(error).__name__.encode())
    return digest.hexdigest()


def describe(
    driver: type[Driver], name: str, settings: Any, made_of: str = ""
) -> tuple[list[object] | None, list[str]]:
    """Let a driver describe a device; return the wire form (see DeviceInfo.unpack) and the errors.

    Args:
        driver: its class.
        name: of the device.
        settings: its settings.
        made_of: see ``contents``; a device whose files have changed is another one.
    """
    stated_hz = getattr(settings, "tick_hz", None)
    if stated_hz is not None and (wrong := _rate_error(stated_hz)):  # drivers divide by it
        return None, [wrong]
    try:
        description = driver.describe(name, settings)
    except (ValueError, OSError) as error:
        return None, [f": {line}" for line in str(error).splitlines()]
    except ArithmeticError as error:
        return None, [f": a number is far out of its range ({error}); want numbers of a machine"]
    errors = _block_errors(description.blocks)
    if wrong := _rate_error(description.tick_hz):
        errors.append(wrong)
    blocks = [
        [
            b.name, int(b.node_class), [c.pack() for c in b.channels],
            b.writable or b.node_class is NodeClass.AXIS, b.history, b.capacity,
        ]
        for b in description.blocks
    ]  # fmt: skip
    variant = driver.variant(settings)
    facts = [
        blocks, description.tick_hz, list(description.reads), description.lease_s, list(variant.claims(settings)),
        made_of, _cost_kind(variant), variant.realtime_priority, list(description.holds),
    ]  # fmt: skip
    return facts, errors


def _rate_error(tick_hz: float) -> str:
    return "" if 0.1 <= tick_hz <= 20_000 else f": rate {tick_hz:g} Hz; want 0.1 to 20000"


def kind_of(driver: type[Driver]) -> str:
    """Return how a driver works: "tick", "line" or "stream"."""
    if issubclass(driver, StreamDriver):
        return "stream"
    return "line" if issubclass(driver, LineDriver) else "tick"


def _cost_kind(driver: type[Driver]) -> str:
    """Return the kind of a driver for what its ticks cost: "compiled" where quiet ones need no Python."""
    if issubclass(driver, TickDriver) and driver.quiet_steps is not TickDriver.quiet_steps:
        return "compiled"
    return kind_of(driver)


MOST_HISTORY = 1 << 20
"""Snapshots that a page keeps at most."""
MOST_PAGE = 1 << 28
"""Bytes of a page at most."""
MOST_COMMANDS = 1 << 20
"""Commands that an axis buffers at most."""


def _block_errors(blocks: Any) -> list[str]:
    errors = []
    names = [block.name for block in blocks]
    for block in blocks:
        channels = [channel.name for channel in block.channels]
        if not channels:
            errors.append(f": block {block.name!r} has no channel; want at least one")
        for name in [c for c in channels if not 0 < len(c) < 256 or not c.isprintable() or any(x in c for x in " /")]:
            errors.append(f": a channel is named {shown(name)}; want a name without blanks and without /")
        for channel in [c for c in block.channels if not c.unit.isprintable() or len(c.unit) > 32]:
            errors.append(f": the unit of {channel.name} is {shown(channel.unit)}; want up to 32 characters")
        if not 4 <= block.history <= MOST_HISTORY or block.history & (block.history - 1):
            errors.append(f": history = {block.history}; want a power of two, 4 to {MOST_HISTORY}")
        elif (size := page_size(block.node_class, len(channels), block.history)) > MOST_PAGE:
            errors.append(
                f": history = {block.history} of {len(channels)} channels takes {size >> 20} MiB; want at most "
                f"{MOST_PAGE >> 20}"
            )
        if not 0 <= block.capacity <= MOST_COMMANDS:
            errors.append(f": capacity = {block.capacity}; want 1 to {MOST_COMMANDS}")
        if block.node_class is NodeClass.AXIS:
            for channel in [c for c in block.channels if c.unit not in ("m", "rad")]:
                errors.append(f": axis {channel.name}: unit = {channel.unit}; want m or rad, as all numbers are SI")
        for name in [c for c, count in Counter(channels).items() if count > 1]:
            errors.append(f": two channels are named {name}; names must differ")
        if names.count(block.name) > 1:
            errors.append(f": two blocks are named {block.name!r}; names must differ")
    return errors
