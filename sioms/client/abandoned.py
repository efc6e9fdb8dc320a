"""What is done about requests that nobody waits for any more: what they did is undone, in both faces."""

from __future__ import annotations

from sioms.protocol.verbs import Close, FreeMarker, Open, ReserveMarker

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from sioms.protocol.verbs import Message


def undoing(abandoned: Message | None, refused: int, value: Any) -> Sequence[Message]:
    """Return the requests that undo an abandoned one which has been answered all the same.

    Args:
        abandoned: the request; None: nothing is known of it, or it did nothing that lasts.
        refused: the errno of its answer, 0: it was carried out.
        value: of its answer.
    """
    if refused:
        return ()
    if isinstance(abandoned, Open):
        return (Close(value[0]),)
    if isinstance(abandoned, ReserveMarker):
        return [FreeMarker(token) for token in value]
    return ()
