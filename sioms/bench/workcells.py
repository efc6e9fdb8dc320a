"""Generated configurations of simulated devices."""

from __future__ import annotations

from collections.abc import Sequence


def axes(
    name: str, count: int = 4, *, tick_hz: float = 1000.0, history: int = 64, capacity: int = 16384,
    velocity: float = 1.0, acceleration: float = 10.0, jerk: float | None = 1000.0, limits: bool = True,
    axis_keys: str = "",
) -> str:  # fmt: skip
    """Return a device of simulated servo axes, named a0, a1 ...

    Args:
        name: of the device.
        count: of axes.
        tick_hz, history, capacity: keys of the device.
        velocity, acceleration, jerk: limits of each axis [m/s, m/s^2, m/s^3], jerk None for no limit.
        limits: whether the axes have soft limits, at -0.4 and 0.4 m.
        axis_keys: further lines of each axis.
    """
    soft = "position_min = -0.4\nposition_max = 0.4\n" if limits else ""
    soft += f"jerk_max = {jerk}\n" if jerk is not None else ""
    one = (
        f"velocity_max = {velocity}\nacceleration_max = {acceleration}\nforce_max = 60.0\n{soft}"
        f"motor = {{ mass = 1.0, viscous = 2.0, encoder_step = 1e-6 }}\n{axis_keys}\n"
    )
    head = (
        f'[device.{name}]\ndriver = "sim-axes"\nrealtime_priority = 50\nlate_max_s = 0.5\ntick_hz = {tick_hz}\nhistory '
        f"= {history}\ncapacity = {capacity}\n"
    )
    return head + "".join(f'[[device.{name}.axis]]\nname = "a{i}"\n{one}' for i in range(count))


def stepper(name: str, *, tick_hz: float = 1000.0, capacity: int = 16384) -> str:
    """Return a device of one simulated stepper axis, named a0."""
    return (
        f'[device.{name}]\ndriver = "sim-axes"\nrealtime_priority = 50\nlate_max_s = 0.5\ntick_hz = {tick_hz}\n'
        f'capacity = {capacity}\n[[device.{name}.axis]]\nname = "a0"\nvelocity_max = 0.5\nacceleration_max = 5.0\n'
        "stepper = { mass = 0.1, step = 1e-3, hold_force = 20.0, coulomb = 1.0 }\n"
    )


def force(name: str, *, tick_hz: float = 1000.0) -> str:
    """Return a device with a six-component force/torque sensor."""
    return f'[device.{name}]\ndriver = "sim-force"\nrealtime_priority = 50\ntick_hz = {tick_hz}\n'


def wave(name: str, period_s: float, *, tick_hz: float = 1000.0) -> str:
    """Return a device with one input bit that a light beam breaks periodically."""
    return (
        f'[device.{name}]\ndriver = "sim-io"\nrealtime_priority = 50\ninputs = 1\ntick_hz = {tick_hz}\n'
        f"[[device.{name}.wave]]\nbit = 0\nperiod_s = {period_s}\nhigh_s = {period_s / 2}\n"
    )


def workcell(devices: Sequence[str], **keys: object) -> str:
    """Return a configuration of devices; keys are those of [workcell]."""
    lines = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return f'[workcell]\nname = "bench"\n{lines}' + "\n".join(devices)
