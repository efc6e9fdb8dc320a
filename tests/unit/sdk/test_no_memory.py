"""An allocation that fails, anywhere in a driver's tick or in what serves its clients, ends in halted motion.

Each one is tried in a process of its own: what fails may be the interpreter itself, which is a death like any other.
"""

from __future__ import annotations

import os
import random
import resource
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import axes
from own_writes_devices import Device, OnLine
from own_writes_rig import World, worlds

from sioms.client.command import command
from sioms.drivers.sim.axes import SimAxes
from sioms.sdk import failing
from sioms.sdk.failing import RESERVE, free_reserve

_testcapi: Any = pytest.importorskip("_testcapi", reason="this interpreter cannot be made to run out of memory")

STRIDE, MOST = 97, 1480
"""Of the allocations of 25 turns, every so-manieth is tried, and up to which."""
ALL = bool(os.environ.get("SIOMS_EVERY_ALLOCATION"))


def moving(kind: str, make: Callable[..., World]) -> World:
    """Return a driver whose axis moves, for a client."""
    if kind == "line":
        world = make(OnLine, {}, 2, Device(random.Random(3)))
    else:
        table = tomllib.loads(axes("dev", "x"))["device"]["dev"]
        world = make(SimAxes, {key: table[key] for key in table.keys() & set(SimAxes.Settings.__struct_fields__)}, 1)
    world.open(0, [0], exclusive=True).write(command(0, velocity=0.05))
    for _ in range(30):
        world.turn(calm=True)
    return world


def is_moving(world: World) -> bool:
    """Tell whether the drive goes on, or the axis that is simulated takes motion."""
    if world.device is not None:
        return world.device.velocity != 0.0
    return not int(world.runtime.blocks[0].bank.arrays["latched"][0])  # type: ignore[union-attr]


def fail_at(kind: str, number: int) -> str:
    """Let one allocation fail; return what became of it: "went on", "failed and halted", or what is wrong."""
    with worlds() as make:
        world = moving(kind, make)
        runtime = world.runtime
        runtime._run_line = lambda: [world._line() for _ in range(60)]  # type: ignore[method-assign]
        if not is_moving(world):
            return "nothing moves"
        error: Exception | None = None
        _testcapi.set_nomemory(number, number + 1)
        try:
            for _ in range(25):
                world.turn(calm=True)
        except Exception as raised:
            error = raised
        finally:
            _testcapi.remove_mem_hooks()
        if error is None:
            return "went on"
        runtime.fail(error)  # as Runtime.run does
        return f"{error!r}: it goes on" if is_moving(world) else "failed and halted"


def in_a_process(what: Callable[[], str]) -> str:
    """Return what a function returns in a process of its own, "died" when that ends without an answer."""
    reader, writer = os.pipe()
    if (pid := os.fork()) == 0:
        try:
            os.write(writer, what().encode())
        except BaseException as error:
            os.write(writer, f"the test: {error!r}".encode())
        finally:
            os._exit(0)
    os.close(writer)
    with open(reader, "rb") as answers:
        answer = answers.read().decode()
    os.waitpid(pid, 0)
    return answer or "died"


@pytest.mark.parametrize("kind", ["simulated", "line"])
def test_wherever_an_allocation_fails_a_driver_goes_on_or_halts(kind: str) -> None:
    numbers = range(0, MOST, 1 if ALL else STRIDE)
    found = [in_a_process(lambda n=number: fail_at(kind, n)) for number in numbers]  # type: ignore[misc]
    assert set(found) <= {"went on", "failed and halted", "died"}, found
    assert found.count("failed and halted") > 3, "else nothing has been tried"


def take_all() -> list[bytes]:
    """Let this process have no more memory, of any size."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size, resource.RLIM_INFINITY))
    taken: list[bytes] = []
    for each in (1 << 20, 1 << 16, 1 << 12, 400, 200, 100, 50, 16):
        try:
            while True:
                taken.append(bytes(each))
        except MemoryError:
            continue
    return taken


def free_and_take() -> str:
    """Return whether there is memory once what is kept for failing has been freed, and none before."""
    taken = take_all()
    before = _can_have(1 << 20)
    free_reserve()
    after = _can_have(1 << 20)
    taken.clear()
    return f"before {before}, after {after}"


def _can_have(size: int) -> bool:
    try:
        bytes(size)
    except MemoryError:
        return False
    return True


def test_what_is_kept_for_failing_is_there_when_nothing_else_is(monkeypatch: pytest.MonkeyPatch) -> None:
    # In this process a test of a driver that fails may have given it up.
    monkeypatch.setattr(failing, "_reserve", bytearray(RESERVE))
    assert in_a_process(free_and_take) == "before False, after True"


def fail_without_memory(kind: str) -> str:
    """Let a driver fail in a process that gets no more memory, of any size; return what became of it."""
    with worlds() as make:
        world = moving(kind, make)
        runtime = world.runtime
        runtime._run_line = lambda: [world._line() for _ in range(60)]  # type: ignore[method-assign]
        taken = take_all()
        runtime.fail(MemoryError())
        told = is_moving(world)
        taken.clear()
        return "it goes on" if told else "halted"


@pytest.mark.parametrize("kind", ["simulated", "line"])
def test_a_driver_that_gets_no_more_memory_stops_what_it_moves(kind: str) -> None:
    assert in_a_process(lambda: fail_without_memory(kind)) == "halted"
