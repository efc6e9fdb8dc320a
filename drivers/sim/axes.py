"""Simulated axes: a motion bank that closes its loop over simulated motors and steppers.

Besides the axes it shows a block ``plant`` with what the simulated world feels of them: the true
position of each load and the force with which it presses on its wall. Simulated sensors read it.
Light beams that look at its own axes may be part of the device, as a binary port ``beams``: they see
the axes a tick earlier than those of another process.

    [device.mod0]
    driver = "sim-axes"
    [[device.mod0.axis]]
    name = "xaxis"
    velocity_max = 0.5
    acceleration_max = 5.0
    force_max = 40.0
    motor = { mass = 2.0, viscous = 4.0, coulomb = 3.0, stiction = 4.0, encoder_step = 1e-6 }
    [[device.mod0.beam]]
    name = "beam0"
    boxes = [{ xaxis = [0.10, 0.14] }]

A device with ``carries = "world.left_joints"``, a node of a ``sim-world``, carries a finger there: its first three
motors are the finger's joints x, y and th, and bear the springs of its mount. An axis with a ``load_node``, an analog
node of one channel, bears the force there [N or N m] beside that of its motor, for what answers slowly. Where such a
node tells nothing (its world is gone, stands still or is late), nothing is borne, brakes hold the axes, and what moves
is in fault until it is reset.

An axis with a ``model_file`` (as ``sioms reconcile`` writes it) is the twin of the axis that the model was found
for: mass, friction, encoder and all effects come from the file, stops and switches from ``motor``. The name and a
check sum of the model show in the plant's description, so that a reload takes up a changed file.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sioms.plant.binary import port_values
from sioms.sdk.blocks import AnyBlock, BinaryBlock, Description
from sioms.sdk.driver import Kit, QuietSteps, TickDriver
from sioms.sdk.exchange import LinkError
from sioms.sdk.pages import Pages

from .axes_step import EDGE
from .axes_table import Built, SimAxesSettings, build, describe
from .axes_world import AxesWorld
from .borne import JOINTS
from .quiet_axes import QuietAxes


class SimAxes(TickDriver):
    """Servo and stepper axes over simulated mechanics.

    Concurrency: the one thread of the driver process.
    """

    Settings = SimAxesSettings
    realtime_priority = 0

    @classmethod
    def describe(cls, name: str, settings: SimAxesSettings) -> Description:
        """Tell the axes and the plant; reads the effects file, so that its mistakes show before the start."""
        if not settings.axis:
            raise ValueError("axis: none given; want a table [[...axis]] for each axis")
        if not 1.0 / settings.tick_hz <= settings.late_max_s < math.inf:
            raise ValueError(
                f"late_max_s {settings.late_max_s:g}; want at least a tick, {1 / settings.tick_hz:g} s, finite"
            )
        motors, _, _ = built = build(settings)
        SimAxes._checked = (settings, built)
        if settings.carries and (motors is None or motors.position.size < JOINTS):
            raise ValueError(f"carries: fewer than {JOINTS} motors; want those of a finger's joints x, y and th first")
        described = describe(settings)
        if described.inputs and not 1.0 / settings.tick_hz < settings.world_age_max_s < math.inf:
            raise ValueError(
                f"world_age_max_s {settings.world_age_max_s:g}; want more than a tick, {1 / settings.tick_hz:g} s"
            )
        return described

    _checked: ClassVar[tuple[SimAxesSettings, Built] | None] = None
    """What ``describe`` has built to check it; a device that is made of the same settings next takes it."""
    make_up_ns: ClassVar[int] = 20_000_000
    """How long a tick may make up for turns [ns]: a machine that is too slow for them shows its axes in slow motion."""

    def __init__(self, name: str, settings: SimAxesSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        checked, SimAxes._checked = SimAxes._checked, None
        built = checked[1] if checked is not None and checked[0] is settings else build(settings)
        self._world = AxesWorld(settings, built, kit.markers, lambda node: self.kit.inputs[node])
        self.bank = self._world.bank

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The axes, the plant and, if there are any, the beams."""
        world = self._world
        return (world.axes, world.plant) if world.port is None else (world.axes, world.plant, world.port)

    def quiet_steps(self, pages: Pages, instants: NDArray[np.int64]) -> QuietSteps | None:
        """Return the steps of motors and steppers, unless something else goes on between commands and positions."""
        motors = self._world.servos
        if self._world.borne is not None or (motors is not None and motors.has_drive_effects):
            return None
        return QuietAxes(self._world, self.make_up_ns, pages, instants)

    def tick(self, now_ns: int) -> None:
        """Let the world go on under the last command up to now, measure, and command anew.

        The controller of a device does not miss its turns because this machine was busy: after a late tick they are
        made up for, a few at once, and shown each at its own time; what that cannot be done for soon is left to the
        next tick, so that others are served meanwhile. Later than ``late_max_s`` the bank stops all motion.
        """
        world = self._world
        if world.found and self._finish_turn(now_ns):
            return
        if now_ns <= world.last_ns and world.command is not None:  # a verb has left this one out
            for block in self.blocks:
                block.stamp_ns = world.last_ns
            return
        world.bear(now_ns)
        behind = world.leave_out(now_ns)
        if now_ns - world.last_ns <= world.late_ns and behind > world.stride:
            behind = self._make_up(behind)
        late = behind > world.stride and now_ns - world.last_ns <= world.late_ns
        if not late:
            self._turn(now_ns, behind)
        for block in self.blocks:
            block.stamp_ns = world.last_ns if late else 0

    def _finish_turn(self, now_ns: int) -> bool:
        """Finish a turn that steps have begun; return whether it was that of the tick, else it is shown as it is."""
        world = self._world
        found, world.found = world.found, 0
        world.finish(found & ~EDGE)
        if world.port is not None:
            self._look(world.port, world.last_ns)
        is_last = round((now_ns - world.last_ns) / world.tick_ns) < 1
        for block in self.blocks:
            block.stamp_ns = 0
            if not is_last:
                self.kit.publish(block, world.last_ns)
        return is_last

    def _make_up(self, behind: int) -> int:
        """Make up for turns, for as long as that may take, and show them; return how many are left."""
        world = self._world
        until_ns = time.monotonic_ns() + self.make_up_ns
        while behind > world.stride:
            at_ns = world.last_ns + world.stride * world.tick_ns
            self._turn(at_ns, world.stride)
            behind -= world.stride
            if behind > world.stride and time.monotonic_ns() >= until_ns:
                break  # this one is shown as that of the tick
            for block in self.blocks:  # what looks at these axes sees them go there
                self.kit.publish(block, at_ns)
        return behind

    def open(self) -> None:
        """Wait for the loads.

        Raises:
            LinkError: one of them is not there.
        """
        borne = self._world.borne
        missing = borne.missing(time.monotonic_ns()) if borne is not None else ""
        if missing:
            raise LinkError(f"{missing}: no load is known; want the simulated world there")

    def _turn(self, now_ns: int, ticks: int) -> None:
        world = self._world
        looks = world.turn(now_ns, ticks)
        self.inputs_ns = world.inputs_ns
        if world.port is not None and looks:
            self._look(world.port, now_ns)

    def is_at_rest(self) -> bool:
        """Whether world and command are at a fixed point; turns that are left out then need not be made up for."""
        return self._world.is_at_rest()

    def slack(self, now_ns: int, until_ns: int) -> None:
        """Let the world go on to the next tick, which is sooner done then, and plan profiles ahead while there is
        time.
        """
        self._world.slack(until_ns)

    def _look(self, port: BinaryBlock, now_ns: int) -> None:
        """Set the beams; of several edges in a tick all but the last are published at once."""
        positions = self._world.plant.data[::2].tolist()
        edges = [(e, bit) for bit, beam in enumerate(self._world.beams) for e in beam.sample(positions, now_ns)]
        for index, (stamp_ns, value) in enumerate(port_values(int(port.data[0]), edges)):
            if index:
                self.kit.publish(port, now_ns)
            port.set(0, value, stamp_ns)


DRIVER = SimAxes
