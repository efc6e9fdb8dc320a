"""What the driver check says of a driver that does not come up."""

from __future__ import annotations

from sioms.check.station import _crash

LOG = r"""time=1 level=info event="device up" device=stage pid=7
time=2 level=error event=driver device=stage text="driver failed: KeyError(8):   File \"a.py\", line 1, in poll     x = y[8]     ~^^^ KeyError: 8 "
time=3 level=error event=driver device=stage text="driver failed: KeyError(9):   File \"a.py\", line 2, in poll     x = y[9]     ~^^^ KeyError: 9 "
time=4 level=error event="device lost" device=stage reason="its driver process ended" then=restarting
"""  # noqa: E501


def test_the_last_crash_is_told_alone() -> None:
    assert _crash(LOG) == 'driver failed: KeyError(9): File "a.py", line 2, in poll x = y[9] KeyError: 9'
    assert _crash(LOG.splitlines()[0]) == ""
