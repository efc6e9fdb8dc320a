"""A driver's hook carried out without a line: the one loop that the rigs of the families share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sioms.sdk.exchange import DeviceError, Exchange, LinkError, Pause, Step, Steps


def carry_out(steps: Steps, answer: Callable[[Step], Any]) -> Any:
    """Carry out a hook to its end, as the kit does.

    Args:
        steps: of the hook.
        answer: carries out one step; what it returns, or the LinkError or DeviceError that it raises, goes back to the
            hook.

    Returns:
        What the hook returns.
    """
    value: Any = None
    failure: Exception | None = None
    while True:
        try:
            step = steps.throw(failure) if failure else steps.send(value)
        except StopIteration as end:
            return end.value
        value, failure = None, None
        try:
            value = answer(step)
        except (LinkError, DeviceError) as error:
            failure = error


class Exchanging:
    """Carries out hooks of a driver that asks and is answered, on an invented clock.

    Args:
        exchange_s: how long an exchange takes.
    """

    def __init__(self, exchange_s: float) -> None:
        self.now_s, self._exchange_s = 1000.0, exchange_s

    def run(self, steps: Steps) -> Any:
        """Carry out a hook to its end."""
        return carry_out(steps, self._carry)

    def reply(self, exchange: Exchange) -> bytes:
        """Return what the device answers."""
        raise NotImplementedError

    def _carry(self, step: Step) -> Any:
        if isinstance(step, Pause):
            self.now_s += step.duration_s
            return None
        assert isinstance(step, Exchange)
        self.now_s += self._exchange_s
        reply = self.reply(step)
        assert step.want(reply) == len(reply)
        return step.decode(reply)
