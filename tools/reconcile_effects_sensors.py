"""The page of the libraries of sensor effects, made from the effects themselves (``sioms reconcile effects sensors``)."""

from __future__ import annotations

from collections.abc import Iterable

from sioms.reconcile.finger.effects import library as of_fingers
from sioms.reconcile.force.effects import library as of_force_sensors
from sioms.reconcile.sensors.effect import TERM_PREFIX, SensorEffect

HEAD = """# The libraries of sensor effects

Made by `sioms reconcile effects sensors`. A number marked "each" stands for every element or component. Outputs of a finger
are fractions of the untouched output, compression positive, strains and angles SI; loads and readings of a force sensor
are shares of each component's full range. Outside its bounds it is not that effect.
"""


def page() -> str:
    """Write both libraries as Markdown."""
    force = (e for e in of_force_sensors(("fx", "fy")).values() if not e.name.startswith(TERM_PREFIX))
    return "\n".join(
        [HEAD, *_part("Tactile finger", of_fingers().values()), *_part("Force/torque sensor", force)]
    )


def _part(title: str, effects: Iterable[SensorEffect]) -> list[str]:
    return [f"## {title}\n", *(section(e) for e in effects)]


def section(effect: SensorEffect) -> str:
    """Write one effect."""
    lines = [f"### {effect.name}: {effect.title}", "", f"`{effect.equation}` ({effect.channel.value})", "",
             "| parameter | unit | bounds | typical | meaning |", "| --- | --- | --- | --- | --- |"]  # fmt: skip
    for q in effect.parameters:
        bounds = "any" if q.phase else f"{q.lower:g} to {q.upper:g}"
        lines.append(
            f"| {q.symbol}{' (each)' if q.each else ''} | {q.unit} | {bounds} | {q.size:g} | {q.text} |"
        )
    lines += ["", f"Where its residual is: {effect.signature}."]
    if effect.lookalikes:
        lines.append(f"Confused with: {', '.join(effect.lookalikes)}. Told apart by: {effect.separate}.")
    if effect.session:
        lines.append(f"Belongs to the session: {', '.join(effect.session)}.")
    if not effect.rankable:
        lines.append("Decided by a channel of its own, before the search.")
    return "\n".join(lines) + "\n"
