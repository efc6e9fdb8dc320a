"""A forked child reads, whatever thread of its parent held the lock meanwhile."""

from __future__ import annotations

import os
import signal

from sioms.client import shown


def test_a_child_forked_while_another_thread_notes_an_acknowledgement_is_not_locked_out() -> None:
    with shown._lock:  # as another thread of the parent has it
        child = os.fork()
        if child == 0:
            signal.alarm(5)  # a deadlock ends it
            shown.acknowledged_by_daemon(0)
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
