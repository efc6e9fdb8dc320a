"""The page of the libraries of sensor effects, made from the effects themselves (``sioms reconcile effects sensors``).

With ``--out docs`` page and pictures are written there.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.finger.effects import library as of_fingers
from sioms.reconcile.force.effects import library as of_force_sensors
from sioms.reconcile.report.effects import PICTURES, section
from sioms.reconcile.sensors.effect import SensorEffect

HEAD = """# The libraries of sensor effects

Made by `sioms reconcile effects sensors --out docs`. A number marked "each" stands for every element or component. Outputs of a finger
are fractions of the untouched output, compression positive, strains and angles SI; loads and readings of a force sensor
are shares of each component's full range. Outside its bounds it is not that effect.

A picture shows what an effect of typical size changes: on a finger in all outputs, that of the element under the edge dark; on a force
sensor in two components, fx dark.
"""  # noqa: E501


def page() -> str:
    """Write both libraries as Markdown."""
    force = (e for e in of_force_sensors(("fx", "fy")).values() if not e.name.startswith(TERM_PREFIX))
    return "\n".join(
        [
            HEAD,
            *_part("Tactile finger", "finger", of_fingers().values()),
            *_part("Force/torque sensor", "force", force),
        ]
    )


def write(folder: Path) -> None:
    """Write the page and the pictures."""
    from sioms.reconcile.report.signatures import pictures

    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    (folder / "reconcile-effects-sensors.md").write_text(page())
    for stem, figure in pictures().items():
        figure.savefig(folder / PICTURES / f"{stem}.png", dpi=60, metadata={"Software": None})


def _part(title: str, kind: str, effects: Iterable[SensorEffect]) -> list[str]:
    return [f"## {title}\n", *(_section(e, kind) for e in effects)]


def _section(effect: SensorEffect, kind: str) -> str:
    rows = [(f"{q.symbol}{' (each)' if q.each else ''}", q, f"{q.size:g}") for q in effect.parameters]
    picture = f"![change by {effect.title}]({PICTURES}/{kind}_{effect.name}.png)"
    text = section(effect, f"`{effect.equation}` ({effect.channel.value})", "typical", rows, picture)
    return text if effect.rankable else text + "Decided by a channel of its own, before the search.\n"
