"""The short way of a command from its acknowledgement to its motion, on an axis for which nothing else waits.

A stream of set-points is one such command after the other, and the arrays of ``Sequencer`` cost the same for one axis
as for a thousand. What is not that case, or is not possible, is the sequencer's: it is the only one that refuses.

Concurrency: that of the bank.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from . import begin_step, modes
from .commands import Command
from .law import ControlLaw
from .plan_step import Plans
from .profile import InfeasibleError
from .queue import CommandQueue
from .sequencer import Sequencer
from .store import FEW
from .types import EventKind

NOT_HERE = modes.ANY_FORCE | modes.SYNCH


class ShortWay:
    """Begins plain commands of a few axes.

    Args:
        sequencer: plans them, and goes on with them.
        queue: where nothing waits.
        law: of the axes.
        plans: what steps work on.
    """

    def __init__(self, sequencer: Sequencer, queue: CommandQueue, law: ControlLaw, plans: Plans) -> None:
        self._sequencer, self._queue, self._law, self._plans = sequencer, queue, law, plans
        self._state = np.asarray(plans.state)

    def begin(self, commands: Sequence[Command], now_ns: int, *, replace: bool) -> bool:
        """Begin commands at now, in place of what runs or where that rests; return False, and nothing is done, where
        that is the sequencer's.

        Args:
            commands: plain ones, which their axes take.
            now_ns: the instant, behind all that was due [ns].
            replace: whether they replace what the axes do.
        """
        sequencer, plans, queue = self._sequencer, self._plans, self._queue
        if len(commands) > FEW or not sequencer.is_plain:
            return False
        axes = sorted({command.axis for command in commands})
        if len(axes) < len(commands) or (self._law.any_braced and self._law.is_braced(np.array(axes)).any()):
            return False
        planned = []
        try:
            for command in commands:
                axis = command.axis
                if command.control_mode & NOT_HERE or not begin_step.may_begin(plans, axis, replace):
                    return False
                begin_step.look_at_state(plans, axis, now_ns)
                position, velocity, acceleration = self._state.tolist()
                taken = not replace and bool(plans.row_taken[plans.row[axis]])
                planned.append(sequencer.planning.planned(axis, command, (position, velocity, acceleration), taken))
        except InfeasibleError:
            return False
        ended = []
        for command, each in zip(commands, planned, strict=True):
            axis = command.axis
            queue.end_with(command)
            sequencer.put(axis, command, each)
            if begin_step.begin(plans, axis, now_ns):
                ended.append(axis)
            self._law.guard[axis] = each.plan.guard
            if command.control_mode & modes.SETTINGS:
                sequencer.planning.put_in_force(axis, command)
        if ended:
            queue.emit(EventKind.ENDED, np.array(ended), now_ns)
        queue.emit(EventKind.STARTED, np.array(axes), now_ns)
        sequencer.begun(axes, now_ns)
        return True
