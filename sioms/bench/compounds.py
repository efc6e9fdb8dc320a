"""Deaths in a workcell with a device made of devices: its client, its driver, the drivers that it holds, the daemon and
the fork server are killed or stopped, alone and in pairs within a millisecond, at random points of its motion.

What is looked at: how soon every held axis stands, whether it stays so, whether an output has two owners, and whether
what was stopped in that millisecond is stopped afterwards.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from sioms.check.daemon import Daemon, wait_for
from sioms.client.command import command
from sioms.protocol.flags import AxisStatus

from .figures import Bar, Report
from .killing import WRONG, Back, Tally, fork_servers, send
from .options import Options
from .watching import HISTORY
from .workcells import workcell

SPEED, DECELERATION = 0.05, 1.0
LEASE_S, DAEMON_LEASE_S = 0.25, 0.5
BAR_S = 0.02
BRAKING_S = SPEED / DECELERATION
"""Braking time of the coordinates; the held axes could brake in a fifth of it."""
HELD = ("portal", "carriage")
DEVICES = (*HELD, "bridge")
SILENT_S = 1.2
"""So long the held axes are watched after the signals: longer than every lease with its braking."""
_LATCHED = int(AxisStatus.EMERGENCY_STOP)
VICTIMS = ("client", "bridge", *HELD, "daemon", "fork server")


class Act(NamedTuple):
    """A signal to a process of the workcell."""

    victim: str
    how: signal.Signals


def bench_compounds(options: Options, report: Report) -> None:
    """Kill and stop until there have been as many rounds as asked for."""
    wanted, chance, tally = options.kills(20, 500), random.Random(options.seed), Tally()
    rounds = 0
    try:
        while rounds < wanted:
            with Daemon(_workcell()) as daemon:
                for _ in range(min(50, wanted - rounds)):
                    rounds += 1
                    try:
                        _round(daemon, chance, tally)
                    except (OSError, RuntimeError) as error:
                        tally.is_wrong("lives that ended in an error", f"{error}; the log ends: {daemon.log()[-600:]}")
                        break
                    report.progress(f"compounds: round {rounds} of {wanted}")
    finally:
        _tell(rounds, tally, report)


def _tell(rounds: int, tally: Tally, report: Report) -> None:
    report.value("rounds", rounds, notes=", ".join(f"{count} {kind}" for kind, count in sorted(tally.kinds.items())))
    report.value("processes killed", tally.signals[signal.SIGKILL])
    report.value("processes stopped", tally.signals[signal.SIGSTOP])
    for note in tally.notes[:20]:
        report.note(note[:300])
    for what, halts in sorted(tally.halts.items()):
        report.samples(f"{what}: held axes stand after what they may take", halts, "ms", bars=[Bar("max", 0.0)],
                       notes=f"{sum(halt > 0 for halt in halts)} later")  # fmt: skip
    for what in WRONG:
        report.value(what, tally.wrong[what], bars=[Bar("value", 0)])


def _workcell() -> str:
    axis = (
        f'[[device.{{}}.axis]]\nname = "{{}}"\nvelocity_max = 0.2\nacceleration_max = {5 * DECELERATION}\n'
        "force_max = 60.0\nmotor = {{ mass = 1.0, viscous = 4.0 }}\n"
    )
    keys = f"realtime_priority = 50\nlate_max_s = 0.5\nhistory = {4 * HISTORY}\n"
    devices = [
        f'[device.{name}]\ndriver = "sim-axes"\nlease_s = {LEASE_S}\n{keys}'
        + "".join(axis.format(name, a) for a in axes)
        for name, axes in (("portal", ("y1", "y2")), ("carriage", ("x",)))
    ]
    coordinates = "".join(
        f'[[device.bridge.axis]]\nname = "{name}"\nvelocity_max = 0.1\nacceleration_max = {DECELERATION}\n'
        for name in ("x", "y", "skew")
    )
    bridge = f'[device.bridge]\ndriver = "gantry"\naxes = ["carriage.x", "portal"]\nspan_m = 1.0\nlease_s = {LEASE_S}\n'
    return workcell([*devices, bridge + keys + coordinates], daemon_lease_s=DAEMON_LEASE_S)


# --- a round -------------------------------------------------------------------------------------


def _round(daemon: Daemon, chance: random.Random, tally: Tally) -> None:
    """Have the bridge moved, kill and stop, look at the held axes, and bring all back."""
    with daemon.cell("judge") as cell:
        _recover(daemon, cell)
        client = daemon.fork(_restless(daemon, chance.getrandbits(32)))
        nodes = {name: cell.open(f"{name}.readonly", timeout=20.0) for name in HELD}
        wait_for(
            lambda: any(any(node.read().commanded_velocity) for node in nodes.values()), 30.0, "the bridge to move"
        )
        time.sleep(chance.random() * 0.4)
        marks = {name: node.read().number for name, node in nodes.items()}
        pids = daemon.device_pids() | {"client": client, "daemon": daemon.pid}
        stopped = chance.choice(("carriage", "bridge", "", "", ""))
        if stopped:
            cell.emergency_stop(stopped)
            time.sleep(chance.random() * 0.001)
        acts = _acts(chance)
        tally.kinds[" and ".join(sorted(f"{act.victim} {act.how.name[3:].lower()}" for act in acts))] += 1
        servers = fork_servers(daemon, set(pids.values()))
        sent = [(pid, act) for act in acts for pid in (servers if act.victim == "fork server" else [pids[act.victim]])]
        begins = send([(pid, act.how) for pid, act in sent], chance, tally)
        begin_of = {act: begin for (_, act), begin in zip(sent, begins, strict=True)}
        time.sleep(SILENT_S)
        until_ns = _until(begin_of)
        dead = {act.victim for act in acts}
        for name, node in nodes.items():
            if name not in dead:
                _judge_halt(node, marks[name], until_ns, min(begins, default=0), _named(acts), tally)
        for pid, act in sent:
            if act.how is signal.SIGSTOP:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        if "client" not in dead:
            daemon.kill(client)
        daemon.reap(client)
    if "daemon" in dead:
        daemon.process.wait(10.0)
        daemon.start()
    with daemon.cell("judge") as cell:
        for name in DEVICES:
            wait_for(Back(cell, name, pids[name] if name in dead else 0), 60.0, f"{name} to be back")
        _judge_owners(cell, tally)
        if stopped:
            _judge_stop(cell, stopped, _named(acts), tally)


def _acts(chance: random.Random) -> list[Act]:
    """Draw one or two victims, and what becomes of each."""
    victims = chance.sample(VICTIMS, chance.choice((1, 2, 2)))
    if victims == ["fork server"]:  # nothing depends on it
        victims.append("client")
    ways = (signal.SIGKILL, signal.SIGKILL, signal.SIGSTOP)
    return [Act(who, signal.SIGKILL if who == "fork server" else chance.choice(ways)) for who in victims]


def _named(acts: Sequence[Act]) -> str:
    """Name what happened by what bounds the halt."""
    return "killed and stopped" if len({act.how for act in acts}) == 2 else f"{acts[0].how.name[3:].lower()}"


def _until(begin_of: dict[Act, int]) -> int:
    """Return until when the held axes have to stand: after the first of what happened that they hear of [ns].

    What becomes of the client and of a held device reaches the others through the driver of the bridge.
    """
    bridge_lives = not any(act.victim == "bridge" for act in begin_of)
    ends = []
    for act, begin_ns in begin_of.items():
        if act.victim == "fork server" or (act.victim in ("client", *HELD) and not bridge_lives):
            continue
        lease_s = 0.0 if act.how is signal.SIGKILL else DAEMON_LEASE_S if act.victim == "daemon" else LEASE_S
        ends.append(begin_ns + int((lease_s + BAR_S + BRAKING_S) * 1e9))
    return min(ends)


def _judge_halt(node: Any, after: int, until_ns: int, begin_ns: int, what: str, tally: Tally) -> None:
    """Note by how much later than it may the last snapshot came in which an axis was commanded to move [ns]."""
    last_ns, shown_ns = begin_ns, 0
    for snapshot in node.history(after, gone=True):
        shown_ns = int(snapshot.stamp_ns)
        if any(snapshot.commanded_velocity):
            last_ns = shown_ns
    tally.halts.setdefault(what, []).append(last_ns - until_ns)
    if last_ns > until_ns:
        tally.notes.append(
            f"{node.name}: {(last_ns - until_ns) / 1e6:.1f} ms late; {dict(tally.kinds)} load {os.getloadavg()[0]:.0f}"
        )
    if last_ns == shown_ns and last_ns > until_ns:
        tally.is_wrong("axes that never halted", f"{node.name}: it moves in its last snapshot")


def _judge_owners(cell: Any, tally: Tally) -> None:
    holders = [row[0] for row in cell.status()["holders"]]
    if len(holders) != len(set(holders)):
        tally.is_wrong("second owners", str(holders))


def _judge_stop(cell: Any, name: str, what: str, tally: Tally) -> None:
    """See that a node is stopped still, now that its device may have been started anew."""
    with cell.open(f"{name}.readonly", timeout=20.0) as node:
        try:
            wait_for(partial(_is_latched, node), 5.0, f"{name} to show its stop")
        except TimeoutError:
            tally.is_wrong("stops lost", f"{name} after {what}")
    cell.reset(name)


def _is_latched(node: Any) -> bool:
    try:
        return all(int(status) & _LATCHED for status in node.read().status)
    except OSError:  # a bridge without its axes shows nothing yet
        return False


def _recover(daemon: Daemon, cell: Any) -> None:
    """Wait until the bridge has its axes, and reset it."""

    def good() -> bool:
        try:
            if not any(
                int(status) & int(AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP) for status in node.read().status
            ):
                return True
            node.reset()
        except OSError:
            time.sleep(0.05)
        return False

    for name in DEVICES:
        wait_for(Back(cell, name, 0), 60.0, f"{name} to be up")
    with cell.open("bridge", "rw", 20.0) as node:
        wait_for(good, 30.0, "the bridge to be good")


def _restless(daemon: Daemon, seed: int) -> Callable[[], None]:
    """Return a client that has the bridge go to and fro, beginning anew at random."""

    def client() -> None:
        chance = random.Random(seed)
        with contextlib.suppress(OSError):  # that its lease runs out on a busy machine is another matter
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        with daemon.cell("mover") as cell, cell.open("bridge", "rw", 20.0, lease=LEASE_S) as bridge:
            _begin(bridge)
            while True:
                x, y = (0.05 * chance.choice((-1.0, 1.0)) for _ in range(2))
                at = bridge.read().position
                x, y = (-abs(v) if p > 0.2 else abs(v) if p < -0.2 else v for v, p in zip((x, y), at, strict=False))
                bridge.write(command(0, velocity=x) + command(1, velocity=y), replace=True)
                for _ in range(chance.randrange(1, 10)):
                    time.sleep(0.04)
                    bridge.keepalive()

    return client


def _begin(bridge: Any) -> None:
    """Have the bridge move for the first time; afterwards any refusal ends the client."""

    def goes() -> bool:
        try:
            bridge.write(command(0, velocity=0.01), replace=True)
        except OSError:  # it was not as good as it had seemed
            time.sleep(0.05)
            with contextlib.suppress(OSError):
                bridge.reset()
            return False
        return True

    wait_for(goes, 20.0, "the bridge to take commands")
