"""The homing cycle of a Grbl controller, without I/O: of all axes at once, and deaf until its end."""

from __future__ import annotations

from collections.abc import Sequence

from .codec import alarm_text


class GrblHoming:
    """A cycle that runs, or has ended and is yet to be told.

    Attributes:
        failure: None while it runs, "" when it has succeeded, else why not.
    """

    def __init__(self) -> None:
        self._began_ns = 0
        self.failure: str | None = None

    @property
    def is_on(self) -> bool:
        """Whether it runs, or its end has not been told."""
        return self._began_ns != 0

    def begin(self, now_ns: int) -> None:
        """Note that it has been asked for."""
        self._began_ns, self.failure = now_ns, None

    def forget(self) -> None:
        """Note that it is over, or that its end has been told."""
        self._began_ns = 0

    def hear(self, lines: Sequence[str], alarm: int) -> None:
        """Look for its end in what the controller says.

        Args:
            lines: that came.
            alarm: number of the present alarm, 0 for none.
        """
        for line in lines:
            if line == "ok":
                self.failure = ""
            elif line.startswith(("error:", "ALARM:")):
                self.failure = alarm_text(alarm) if alarm else f"homing refused: {line}"

    def watch(self, now_ns: int, timeout_s: float) -> None:
        """Let it fail when it takes longer than a time [s]."""
        if self.failure is None and now_ns - self._began_ns > timeout_s * 1e9:
            self.failure = f"homing took longer than {timeout_s:g} s"
