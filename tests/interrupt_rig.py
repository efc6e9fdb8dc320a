"""Interrupts at every place at which Python heeds a signal."""

from __future__ import annotations

import dis
import signal
import sys
from collections.abc import Callable, Iterator
from types import FrameType

PLACES = ("CALL", "CALL_FUNCTION_EX", "RESUME")


class Interrupt:
    """Raises KeyboardInterrupt behind the n-th call, or entry, in some modules: there Python heeds signals.

    Args:
        at: n.
        modules: their names.
        but: functions that are left out.
        is_signal: it is a signal, which a handler of the program may put off.
    """

    def __init__(
        self, at: int, modules: tuple[str, ...], but: tuple[str, ...] = (), *, is_signal: bool = False
    ) -> None:  # fmt: skip
        self.left, self.modules, self.but, self.is_signal = at, modules, but, is_signal
        self.last: dict[FrameType, int] = {}

    def __call__(self, frame: FrameType, event: str, argument: object) -> Interrupt | None:
        if frame.f_globals.get("__name__") not in self.modules or frame.f_code.co_name in self.but:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            before = self.last.get(frame, -1)
            self.last[frame] = frame.f_lasti
            if before >= 0 and dis.opname[frame.f_code.co_code[before]] in PLACES:
                self.left -= 1
                if self.left == 0:
                    self.last.clear()  # frames keep what was under way
                    if self.is_signal:
                        signal.raise_signal(signal.SIGINT)
                    else:
                        raise KeyboardInterrupt
        return self


def interrupted_everywhere(
    do: Callable[[], object], modules: tuple[str, ...], but: tuple[str, ...] = (), step: int = 1,
    is_signal: bool = False,
) -> Iterator[int]:  # fmt: skip
    """Do something again and again, interrupted one place (or ``step``) later each time, until it is done.

    Yields each place, after its interrupt.
    """
    at, tracing = 0, sys.gettrace()
    while True:
        at, interrupted = at + step, False
        sys.settrace(Interrupt(at, modules, but, is_signal=is_signal))
        try:
            do()
        except KeyboardInterrupt:
            interrupted = True
        finally:
            sys.settrace(tracing)
        if not interrupted:
            return
        yield at  # when nobody holds the interrupt any more, and with it what was under way
