"""The part of the demo with real protocols: drives, sample stream and I/O block as processes of their own."""

from __future__ import annotations

import time
from contextlib import ExitStack
from importlib.resources import files

import sioms
from sioms.children import PATIENCE_S, Process, daemon

from .pace import patient
from .rig import bold, waiting

PORTS = {"/dev/ttyUSB0": "drives", "/dev/ttyACM0": "finger", "192.168.127.254:502": "io"}
"""Port names of the configuration, and the simulator that takes the place of each."""


def bench(folder: str, stack: ExitStack) -> str:
    """Start the simulators; return the path of the configuration with their port names and patience in it."""
    drives, finger = f"{folder}/ttyUSB0", f"{folder}/ttyACM0"
    base = "sioms.drivers"
    started = [  # all at once: each takes its time on a busy machine
        ([f"{base}.modbus.simulated.moxa", "--model", "E1212", "--port", "0"], "the I/O block"),
        ([f"{base}.modbus.simulated.leadshine", "--link", drives, "--units", "1"], "the drive"),
        ([f"{base}.framed_adc.simulator", "--link", finger, "--channels", "16"], "the sample stream"),
    ]
    processes = [Process(arguments, "ready", waits=False) for arguments, _ in started]
    for process in processes:
        stack.callback(process.end)
    for process, (_, what) in zip(processes, started, strict=True):
        with waiting(f"the simulator of {what}"):
            process.wait_ready()
    io = processes[0]
    text = patient(files("sioms.tools.demo").joinpath("bench-modbus.toml").read_text())
    names = {"drives": drives, "finger": finger, "io": io.ready_line.split()[-1]}
    for port, simulator in PORTS.items():
        text = text.replace(port, names[simulator])
    path = f"{folder}/bench-modbus.toml"
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)
    return path


def show(folder: str) -> None:
    """Run the bench configuration and use its nodes like any others."""
    print(
        f"\n{bold('Real protocols')}   the same verbs on a Modbus RTU drive, a framed sample stream and a Modbus TCP "
        "block",
        flush=True,
    )
    with ExitStack() as stack:
        config = bench(folder, stack)
        with waiting("siomsd to start its drivers"):
            process = daemon(config, f"{folder}/bench.sock")
        stack.callback(process.end)
        with sioms.Workcell(name="demo") as cell:
            with waiting("the links of all devices"):
                _wait_links(cell)
            for device in cell.status()["devices"]:
                print(f"  {device['name']:10} {device['driver']:12} {device['link']} {device['link_reason']}")
            _move(cell)
            with cell.open("tactile0") as finger:
                first = finger.read()
                time.sleep(1.0)
                last = finger.read()
                rate = (last.number - first.number) / (last.stamp_ns - first.stamp_ns) * 1e9
                print(f"  tactile0   {rate:.0f} frames/s, {len(last)} elements, flags {set(last.flags)}")
            with cell.open("io0.do", "rw") as outputs:
                outputs.set(0b101)
                with waiting("the outputs to be read back"):
                    read = outputs.wait_new(outputs.read().number, PATIENCE_S)
                print(f"  io0.do     outputs written and read back: {read.data[0]:#010b}")


def _wait_links(cell: sioms.Workcell) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while any(device["link"] != "good" for device in cell.status()["devices"]):
        if time.monotonic() > deadline:
            raise RuntimeError(f"a link did not come up: {cell.status()['devices']}")
        time.sleep(0.05)


def _move(cell: sioms.Workcell) -> None:
    with cell.open("slide0", "rw") as axis:
        began = time.monotonic()
        axis.move(0.02)
        with waiting("slide0 to come to rest"):
            axis.wait_until_idle(PATIENCE_S)
        print(f"  slide0     moved to {axis.read().position[0] * 1e3:.2f} mm in {time.monotonic() - began:.2f} s")
        axis.command(velocity=-0.01)
        time.sleep(0.4)
        cell.emergency_stop(why="demo")
        time.sleep(0.3)
        reading = axis.read()[0]
        print(f"  slide0     emergency stop: {reading.velocity * 1e3:.2f} mm/s at {reading.position * 1e3:.2f} mm")
        cell.reset()
