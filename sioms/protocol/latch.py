"""The emergency-stop latch: a page of shared memory that every driver looks at in every tick.

It is written by the daemon alone: ``stopped_ns`` is 0, or the time when the workcell was stopped; the daemon also
stamps ``daemon_alive_ns`` in it, from its real loop. Clients ask for a stop through the daemon or through the
stop-request file (``stopfile``), drivers through that file; they can thus cause a stop but never clear one.

The workcell is stopped while the latch is, or while the file says something else than ``answered_request``. Who was
stopped stays so until ``resets`` changes: that is the last word of a reset that is written.

This is a software stop (category 1 or 2 of IEC 60204-1 at best), not a safety-rated function.
"""

from .page import fence
from .text import printable

LATCH_SIZE = 4096
_STOPPED, _RESETS, _ALIVE, _ANSWERED, _ANSWERED_AT, _ORDERS, _RESET_AT, _ENDED = range(8)
_TEXT, _TEXT_SIZE = 64, 256
_SEPARATE = 576
_ENDED_AT, _RESET_SENT = 0, 1
"""Words that no steps look at: when the last stop was ended; when the last reset was sent."""


class Latch:
    """View of the latch page.

    Args:
        buffer: the latch page, LATCH_SIZE bytes; writable in the daemon.

    Concurrency: one process writes; stores are single words; the count of resets comes behind all that a reset says,
    and is looked at before it, on any processor.
    """

    def __init__(self, buffer: memoryview) -> None:
        self._bytes = buffer
        self._words = buffer[:64].cast("Q")
        self._separate = buffer[_SEPARATE : _SEPARATE + 16].cast("Q")

    @property
    def stopped_ns(self) -> int:
        """Time of the stop [ns, CLOCK_MONOTONIC], 0 when not stopped."""
        return self._words[_STOPPED]

    @property
    def resets(self) -> int:
        """How often the latch has been cleared; a stop between two looks shows as a change. All that a reset says is
        there before it changes, and is looked at after it.
        """
        resets = self._words[_RESETS]
        fence()
        return resets

    @property
    def reset_ns(self) -> int:
        """When the latch was cleared last [ns, CLOCK_MONOTONIC]; 0: never."""
        return self._words[_RESET_AT]

    @property
    def ended_stop_ns(self) -> int:
        """Which stop was the last that a reset has ended, as ``stopped_ns``; 0: none."""
        return self._words[_ENDED]

    @property
    def ended_ns(self) -> int:
        """When that stop was ended [ns, CLOCK_MONOTONIC]; later resets may have ended none."""
        return self._separate[_ENDED_AT]

    @property
    def reset_sent_ns(self) -> int:
        """When the last reset was sent, at the earliest [ns, CLOCK_MONOTONIC]: it ends no later stop."""
        return self._separate[_RESET_SENT]

    @property
    def daemon_alive_ns(self) -> int:
        """Last stamp of the daemon's loop [ns, CLOCK_MONOTONIC]."""
        return self._words[_ALIVE]

    @property
    def orders(self) -> int:
        """How many orders the daemon has sent to drivers on their control sockets; one more: look there."""
        return self._words[_ORDERS]

    def ordered(self) -> None:
        """Note that an order has been sent (the daemon's), so that the driver's next tick obeys it first."""
        self._words[_ORDERS] += 1

    @property
    def source(self) -> str:
        """Who stopped and why."""
        text = bytes(self._bytes[_TEXT : _TEXT + _TEXT_SIZE]).split(b"\0")[0]
        return printable(text.decode("utf-8", "replace"))

    def stop(self, now_ns: int, source: str) -> bool:
        """Latch the stop; return whether it was not latched before."""
        if self._words[_STOPPED]:
            return False
        self.name_source(source)
        self._words[_STOPPED] = now_ns
        return True

    def name_source(self, source: str) -> None:
        """Say better who stopped."""
        text = printable(source).encode()[: _TEXT_SIZE - 1]
        self._bytes[_TEXT : _TEXT + _TEXT_SIZE] = text.ljust(_TEXT_SIZE, b"\0")

    @property
    def answered_request(self) -> tuple[int, int]:
        """Mark of the stop-request file that the last reset answered: any other is a stop that no reset has ended.
        Until ``resets`` changes it may be half of what is being written.
        """
        return self._words[_ANSWERED], self._words[_ANSWERED_AT]

    def begin(self, resets: int, request: tuple[int, int]) -> None:
        """Begin with the number of resets there have been, and the mark of a stop-request file to which nobody has
        written yet.
        """
        self._words[_RESETS] = resets
        self._words[_ANSWERED], self._words[_ANSWERED_AT] = request

    def reset(self, now_ns: int, request: tuple[int, int] | None = None, sent_ns: int | None = None) -> None:
        """Clear the latch, on behalf of somebody entitled.

        Args:
            now_ns: time of the reset: what clients have sent before it is not taken after it [ns, CLOCK_MONOTONIC].
            request: mark of the stop-request file that is thereby answered; None: no other than before.
            sent_ns: when it was sent, at the earliest [ns, CLOCK_MONOTONIC]; None: now.
        """
        self._words[_RESET_AT] = now_ns
        self._separate[_RESET_SENT] = now_ns if sent_ns is None else sent_ns
        if self._words[_STOPPED]:
            self._separate[_ENDED_AT] = now_ns
            self._words[_ENDED] = self._words[_STOPPED]
            fence()  # who does not find the stop any more finds that it was there
        if request is not None:
            self._words[_ANSWERED_AT] = request[1]
            self._words[_ANSWERED] = request[0]  # last: half of it is older than the request
        self._words[_STOPPED] = 0
        fence()
        self._words[_RESETS] += 1

    def daemon_alive(self, now_ns: int) -> None:
        """Stamp the daemon's loop as alive."""
        self._words[_ALIVE] = now_ns

    def release(self) -> None:
        """Drop the views, so that the mapping can be closed."""
        self._words.release()
        self._separate.release()
        self._bytes.release()
