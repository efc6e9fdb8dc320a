"""The lowest real-time class, for threads that a busy machine must not keep waiting."""

from __future__ import annotations

import os


def be_prompt() -> bool:
    """Have this thread run ahead of all ordinary ones, and behind all drivers, where the system allows it.

    ``LimitRTPRIO`` of a unit, or ``rtprio`` of limits.conf, does. What the thread starts is ordinary again.

    Returns:
        Whether it does so from now on.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except OSError:
        return False
    return True
