"""The page of the library of effects, made from the effects themselves (``sioms reconcile effects``)."""

from __future__ import annotations

from sioms.reconcile.effect import Channel, Effect
from sioms.reconcile.effects import library

HEAD = """# The library of axis effects

Made by `sioms reconcile effects`; {F} is N or N m, {x} is m or rad, theta is 2 pi x / pitch.
Bounds are multiples of the natural size of the parameter on the axis; outside them it is not that effect.
"""


def page() -> str:
    """Write the whole library as Markdown."""
    parts = [HEAD]
    for channel in Channel:
        parts.append(f"## {channel.value}\n")
        parts += [section(e) for e in library().values() if e.channel is channel]
    return "\n".join(parts)


def section(effect: Effect) -> str:
    """Write one effect."""
    kinds = " and ".join(k for k, yes in (("rotary", effect.rotary), ("linear", effect.linear)) if yes)
    lines = [f"### {effect.name}: {effect.title}", "", f"`{effect.equation}`", "",
             "| parameter | unit | bounds | of | meaning |", "| --- | --- | --- | --- | --- |"]
    for p in effect.parameters:
        bounds = "any" if p.phase else f"{p.lower:g} to {p.upper:g}"
        lines.append(f"| {p.symbol} | {p.unit} | {bounds} | {p.ref.value} | {p.text} |")
    lines += ["", f"Where its residual is: {effect.signature}. On {kinds} axes.",
              f"Confused with: {', '.join(effect.lookalikes)}. Told apart by: {effect.separate}."]
    if effect.session:
        lines.append(f"Belongs to the session: {', '.join(effect.session)}.")
    return "\n".join(lines) + "\n"
