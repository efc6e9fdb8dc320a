"""A driver's hook carried out without a line: the one loop that the rigs of the families share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sioms.sdk.exchange import DeviceError, LinkError, Step, Steps


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
