"""The page of the library of effects, made from the effects themselves, with a picture of each one's signature.

``sioms reconcile effects`` prints the page; with ``--out docs`` it writes page and pictures.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sioms.reconcile.effect import AnyEffect, Array, Channel, Effect
from sioms.reconcile.effects import library
from sioms.reconcile.model import AxisModel, Controller

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEAD = """# The library of axis effects

Made by `sioms reconcile effects --out docs`; {F} is N or N m, {x} is m or rad, theta is 2 pi x / pitch.
Bounds are multiples of the natural size of the parameter on the axis; outside them it is not that effect.

A picture shows what an effect of typical size leaves in force, J y'' + b y' - u of the measured motion y, on the
same axis in closed loop under the same commands (reversals, cruises, sines): against time, speed and place.
"""
PICTURES = "pictures/effects"
#: The axis of the pictures: 2 g m^2, 0.7 N m, with a loop of 10 Hz.
AXIS = AxisModel(True, 1e-3, 2e-3, 1e-3, 1e-9, 2 * np.pi, 0.7, 20.0, Controller(17.5, -0.979, -0.8, 0.0, 0.0, 1.8, 0.0))
#: Values that show better than the typical ones.
SHOWN = {
    "encoder_scale": {"gain": 1.02},
    "encoder_quantisation": {"factor": 4e5},
    "saturation": {"limit": 0.25},
    "cogging": {"n": 5.0},
    "torque_ripple": {"n": 5.0},
    "coulomb_position": {"n": 2.0},
    "friction_variation": {"depth": 0.4, "n": 2.0},
    "thermal_gain": {"loss": 1.0, "tau": 3.0},
    "backlash": {"gap": 0.02},
    "eccentricity": {"amp": 0.02},
}


def page() -> str:
    """Write the library of axis effects as Markdown."""
    parts = [HEAD]
    for channel in Channel:
        parts.append(f"## {channel.value}\n")
        parts += [_section_of_axis(e) for e in library().values() if e.channel is channel]
    return "\n".join(parts)


def _section_of_axis(effect: Effect) -> str:
    kinds = " and ".join(k for k, yes in (("rotary", effect.rotary), ("linear", effect.linear)) if yes)
    beside = f"Only beside {', '.join(effect.beside)}; in the picture beside the first."
    rows = [(p.symbol, p, p.ref.value) for p in effect.parameters]
    picture = f"![residual of {effect.title}]({PICTURES}/{effect.name}.png)"
    more = [beside] if effect.beside else []
    return section(effect, f"`{effect.equation}`", "of", rows, picture, f" On {kinds} axes.", more)


def section(
    effect: AnyEffect,
    equation: str,
    scale: str,
    rows: Iterable[tuple[str, Any, str]],
    picture: str,
    where: str = "",
    more: Iterable[str] = (),
) -> str:
    """Write one effect of any subject.

    Args:
        scale: head of the column of natural sizes; rows: name of each parameter, itself, and its natural size.
        where: is said after where its residual is; more: lines after what it is confused with.
    """
    lines = [f"### {effect.name}: {effect.title}", "", equation, ""]
    lines += [f"| parameter | unit | bounds | {scale} | meaning |", "| --- | --- | --- | --- | --- |"]
    for symbol, p, size in rows:
        bounds = "any" if p.phase else f"{p.lower:g} to {p.upper:g}"
        lines.append(f"| {symbol} | {p.unit} | {bounds} | {size} | {p.text} |")
    lines += ["", picture, "", f"Where its residual is: {effect.signature}.{where}"]
    if effect.confounders:
        lines.append(f"Confused with: {', '.join(effect.confounders)}. Told apart by: {effect.separate}.")
    lines += more
    if effect.session:
        lines.append(f"Belongs to the session: {', '.join(effect.session)}.")
    return "\n".join(lines) + "\n"


def write(folder: Path) -> None:
    """Write the page and the pictures."""
    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    (folder / "reconcile-effects.md").write_text(page())
    for effect in library().values():
        figure = picture(effect)
        figure.savefig(folder / PICTURES / f"{effect.name}.png", dpi=60, metadata={"Software": None})


def trace(effect: Effect) -> tuple[Array, Array, Array, Array]:
    """Return time [s], measured speed, measured position and the force that the effect leaves, shape (n,)."""
    from sioms.reconcile.experiment import Envelope, catalogue
    from sioms.reconcile.simulate import simulate

    laps = {e.name: e.command for e in catalogue(AXIS, Envelope.of(AXIS, 0.0, 4.0), 3.0)}
    command = np.concatenate([laps[n] for n in ("slow_reversals", "cruises", "multi_sine")])
    shown = [library()[n] for n in effect.beside[:1]] + [effect]
    effects = {e.name: {p.symbol: p.start * AXIS.scale(p) for p in e.parameters} | SHOWN.get(e.name, {}) for e in shown}
    run = simulate(replace(AXIS, effects=effects), command, substeps=8)
    dt = AXIS.sample_time_s
    v: Array = np.gradient(run.position, dt)
    # The force is held over a sample, so the motion that it makes is seen over the two samples around it.
    a = (run.position[2:] - 2.0 * run.position[1:-1] + run.position[:-2]) / dt**2
    f = AXIS.inertia * a + AXIS.viscous * v[1:-1] - 0.5 * (run.force[1:-1] + run.force[:-2])
    return np.arange(len(f), dtype=np.float64) * dt, v[1:-1], run.position[1:-1], f


def picture(effect: Effect) -> Figure:
    """Draw what an effect leaves."""
    from matplotlib.figure import Figure

    t, v, x, f = trace(effect)
    figure = Figure(figsize=(11, 2.3), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True, width_ratios=(2, 1, 1))
    for a, against, label in zip(axes, (t, v, x), ("time / s", "speed / rad/s", "position / rad"), strict=True):
        a.plot(against, f, "-" if against is t else ".", ms=1, lw=0.6, color="#1f5f8b")
        a.set_xlabel(label)
        a.grid(visible=True, lw=0.3)
    top = 1.2 * float(np.quantile(np.abs(f), 0.998)) + 1e-6
    axes[0].set_ylim(-top, top)
    axes[0].set_ylabel("residual / N m")
    return figure
