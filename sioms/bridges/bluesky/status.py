"""What a device answers when something takes time: done or not, and how it ended."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Status:
    """The state of something that takes time; see ``bluesky.protocols.Status``.

    Args:
        what: what is done, for messages.

    Concurrency: any threads.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._event = threading.Event()
        self._lock = threading.Lock()
        self._error: BaseException | None = None
        self._callbacks: list[Callable[[Status], None]] = []

    def __repr__(self) -> str:
        state = "under way" if not self.done else "done" if self.success else f"failed: {self._error}"
        return f"<{type(self).__name__} {self._what}: {state}>"

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._event.is_set()

    @property
    def success(self) -> bool:
        """Whether it has ended as it was to."""
        return self.done and self._error is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """Return why it failed, None: it did not.

        Raises:
            TimeoutError: it has not ended within so long [s].
        """
        if not self._event.wait(timeout):
            raise TimeoutError(f"{self._what}: not within {timeout:g} s")
        return self._error

    def wait(self, timeout: float | None = None) -> None:
        """Wait for its end; raise why it failed."""
        if error := self.exception(timeout):
            raise error

    def add_callback(self, callback: Callable[[Status], None]) -> None:
        """Have something called when it ends, at once if it has."""
        with self._lock:
            if not self.done:
                self._callbacks.append(callback)
                return
        callback(self)

    def finish(self, error: BaseException | None = None) -> None:
        """End it."""
        with self._lock:
            self._error = error
            self._event.set()
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)


def begin(what: str, work: Callable[[], None]) -> Status:
    """Do something that takes time in a thread of its own; return its state."""
    status = Status(what)

    def run() -> None:
        try:
            work()
        except Exception as error:
            status.finish(error)
        else:
            status.finish()

    threading.Thread(target=run, name=what, daemon=True).start()
    return status
