"""``sioms reconcile axis NODE``: design the experiment, ask, run it, decide, and put the model to work.

The workflow sees what any client sees: readings of the node. It knows nothing of the simulated world behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import sioms
from sioms.client.reading import AxisReading
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.reconcile.axis import analyse
from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.experiment import Envelope, Experiment, catalogue, one_speed, repeated
from sioms.reconcile.live.experiments import Say, agree, decide
from sioms.reconcile.live.record import perform
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.prepare import Options
from sioms.reconcile.records import Record, Session
from sioms.reconcile.simulate import simulate

#: Shares of the axis's own limits that an experiment asks for.
SHARE, JERK_SHARE = 0.6, 0.3
#: Share of the free range that is used, and of the largest force that the nominal model may need.
RANGE_SHARE, FORCE_SHARE = 0.9, 0.8
LAPS = 2
LAP_S = 3.0
#: Separating experiments after the first records.
ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Live:
    """What a user asks of a live run.

    Attributes:
        travel: largest distance from the present position to either side, None for the whole range.
        lap_s: length of one lap of each experiment [s].
        first: "full" for the whole catalogue, "one_speed" for the gentlest lap only.
        yes: move without asking.
        socket: of the daemon, None for the usual one.
    """

    travel: float | None = None
    lap_s: float = LAP_S
    first: str = "full"
    yes: bool = False
    socket: str | None = None
    seed: int = 1


def live(node: str, nominal: AxisModel, settings: Live, folder: Path, say: Say) -> tuple[AxisVerdict, float]:
    """Reconcile an axis behind a daemon.

    Args:
        folder: where the records go, readable as DATA.

    Returns:
        The verdict and the seconds of analysis.

    Raises:
        BadInputError: the node is no such axis, or the user did not agree.
        ExperimentStopped: the experiment was stopped; the axis is halted.
        OSError: the daemon or the node cannot be reached.
    """
    if nominal.imposed:
        raise BadInputError(
            f"measure {node}: the model says imposed = true, of a rig that another machine moves; record it, and give "
            "the folder of the records instead of the node"
        )
    with sioms.Workcell(settings.socket, "reconcile") as cell:
        channel = _channel(cell.info(node), nominal)
        with cell.open(f"{node}.readonly") as axis:
            model, here = _with_controller(nominal, axis.read()[0], channel), float(axis.read().position[0])
        envelope = _envelope(channel, model, here, settings.travel)
        plan = _gentle(model, _first(model, envelope, settings), channel)
        _agree(node, model, envelope, plan, settings)

        def run(experiments: Sequence[Experiment]) -> list[Record]:
            return perform(cell, node, _gentle(model, experiments, channel), envelope, say)

        def separate(best: Experiment) -> None:
            records.extend(run([repeated(replace(best, name=f"separate_{best.name}"), LAPS)]))

        records = run(plan)
        options = Options(seed=settings.seed, envelope=envelope, progress=say)
        found = decide(
            lambda: analyse(Session(tuple(records)), model, options),
            separate,
            lambda verdict: verdict.experiment,
            ROUNDS,
            say,
        )
    save(Session(tuple(records)), folder)
    return found


def _channel(info: NodeInfo, model: AxisModel) -> ChannelInfo:
    """Check that the node is the kind of axis that the model is of."""
    where = f"reconcile {info.name}"
    if info.node_class is not NodeClass.AXIS or len(info.channels) != 1 or info.read_only:
        raise BadInputError(f"{where}: it is no single axis that can be written; give the node of one axis")
    channel = info.channels[0]
    if channel.unit != model.position_unit:
        raise BadInputError(f"{where}: it is in {channel.unit}, the model in {model.position_unit}")
    if abs(info.tick_hz * model.sample_time_s - 1.0) > 1e-6:
        raise BadInputError(f"{where}: it ticks at {info.tick_hz:g} Hz, the model at {1 / model.sample_time_s:g} Hz")
    if "force" not in channel.limits:
        raise BadInputError(f"{where}: it commands no force; the force is what the workflow judges by")
    return channel


def _with_controller(model: AxisModel, reading: AxisReading, channel: ChannelInfo) -> AxisModel:
    """Take the gains from the axis itself; offset and velocity filter from the model, where it has them."""
    given = model.controller
    offset, filter_hz = (given.offset, given.velocity_filter_hz) if given is not None else (0.0, 0.0)
    k, kz, kp, kb = (float(getattr(reading, gain)) for gain in ("k", "kz", "kp", "kb"))
    return replace(model, controller=Controller(k, kz, kp, kb, offset, float(channel.limits["force"]), filter_hz))


def _envelope(channel: ChannelInfo, model: AxisModel, here: float, travel: float | None) -> Envelope:
    """Take the middle of the allowed range and shares of the limits."""
    low = channel.minimum if channel.minimum is not None else -np.inf
    high = channel.maximum if channel.maximum is not None else np.inf
    if travel is not None:
        low, high = max(low, here - travel), min(high, here + travel)
    if not (np.isfinite(low) and np.isfinite(high)):
        raise BadInputError(
            f"plan experiments on {channel.name}: its range has no end; give --travel, the distance from here "
            f"({here:.4g} {channel.unit}) to either side that is safe"
        )
    reach = 0.5 * RANGE_SHARE * (high - low)
    if reach < 100.0 * model.resolution:
        raise BadInputError(
            f"plan experiments on {channel.name}: {2.0 * reach:.3g} {channel.unit} to move in; needs hundreds of "
            f"counts ({model.resolution:.3g} {channel.unit} each)"
        )
    limits = channel.limits
    speed = min(SHARE * limits["velocity"], model.max_speed)
    acceleration = min(SHARE * limits["acceleration"], 0.5 * limits["force"] / model.inertia)
    jerk = min(JERK_SHARE * limits.get("jerk", np.inf), 100.0 * acceleration)
    return Envelope(0.5 * (low + high), reach, speed, acceleration, jerk)


def _first(model: AxisModel, envelope: Envelope, settings: Live) -> list[Experiment]:
    laps = catalogue(model, envelope, settings.lap_s) if settings.first == "full" else ()
    return [repeated(e, LAPS) for e in (*laps, one_speed(model, envelope, settings.lap_s))]


def _gentle(model: AxisModel, plan: Sequence[Experiment], channel: ChannelInfo) -> list[Experiment]:
    """Shrink what would need more force than there is, by the nominal model."""
    out = []
    for e in plan:
        peak = float(np.max(np.abs(simulate(replace(model, start_position=float(e.command[0])), e.command).force)))
        share = min(1.0, FORCE_SHARE * channel.limits["force"] / max(peak, 1e-300))
        out.append(replace(e, command=e.command[0] + share * (e.command - e.command[0])))
    return out


def _agree(node: str, model: AxisModel, envelope: Envelope, plan: Sequence[Experiment], settings: Live) -> None:
    """Say what will be done and ask.

    Raises:
        BadInputError: the answer is not yes, or there is nobody to ask.
    """
    unit, seconds = model.position_unit, sum(len(e.command) for e in plan) * model.sample_time_s
    told = [
        f"{node} will move between {envelope.centre - envelope.reach:.4g} and {envelope.centre + envelope.reach:.4g} "
        f"{unit}, "
        f"up to {envelope.speed:.3g} {unit}/s and {envelope.acceleration:.3g} {unit}/s^2, for some {seconds:.0f} s:",
        *(f"  {e.name}: {e.text}" for e in plan),
    ]
    agree(f"move {node}", told, "move it?", settings.yes)


def save(session: Session, folder: Path) -> None:
    """Keep the records beside the report, readable as DATA."""
    lines = [
        "continuous = true",
        "files = [" + ", ".join(f'"{r.name}.csv"' for r in session.records) + "]",
        "[columns]",
    ]
    lines += [f'{name} = {{ name = "{name}" }}' for name in ("time", "position", "force", "command")]
    folder.mkdir(parents=True, exist_ok=True)
    for r in session.records:
        table = np.column_stack([r.time_s, r.position, r.force, r.command])  # type: ignore[list-item]
        np.savetxt(folder / f"{r.name}.csv", table, "%.12g", ",", header="time,position,force,command", comments="")
    (folder / "columns.toml").write_text("\n".join(lines) + "\n")
