"""What the daemon tells a driver process to do.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from sioms.protocol import driver_verbs
from sioms.protocol.latch import Latch
from sioms.protocol.verbs import Message

from .attachments import Attachments
from .blocks import AnyBlock
from .held import Held
from .inputs import Input
from .stops import Stops


class Orders:
    """Carries out the orders of the daemon.

    Args:
        blocks: of the device.
        clients, stops, inputs, held, latch: of the driver process.
        log: writes a line of a level to the daemon's log.
        end: stops everything and lets the process end, for a reason.
        stop_held: stops all axes of other devices that this one holds.

    Attributes:
        is_used: whether somebody reads this device through another one.
    """

    def __init__(
        self, blocks: Sequence[AnyBlock], clients: Attachments, stops: Stops, inputs: Mapping[str, Input],
        held: Mapping[str, Held], latch: Latch, log: Callable[[str, str], None], end: Callable[[str], None],
        stop_held: Callable[[], None],
    ) -> None:  # fmt: skip
        self.is_used = False
        self._blocks, self._clients, self._stops = blocks, clients, stops
        self._inputs, self._held, self._latch = inputs, held, latch
        self._log, self._end, self._stop_held = log, end, stop_held

    def obey(self, message: Message, fds: list[int]) -> None:
        """Carry out an order, which has come with descriptors."""
        match message:
            case driver_verbs.Attach():
                self._clients.attach(fds, message)
            case driver_verbs.Detach(handle, errno_, reason):
                self._clients.detach(handle, errno_, reason)
            case driver_verbs.InUse(used):
                self.is_used = used
            case driver_verbs.StopChanged():
                self._stops.look()
            case driver_verbs.Shutdown():
                self._end("the device was taken out of service")
            case driver_verbs.Input(name, channels, bit):
                if not fds:  # the kernel drops what goes beyond the limit
                    self._log("error", f"{name} cannot be read: too many open descriptors")
                    return
                self._inputs[name].attach(fds[0], channels, bit)
            case driver_verbs.Held(name, channels):
                if not fds:
                    self._log("error", f"{name} cannot be held: too many open descriptors")
                    return
                was_held = self._held[name].is_there
                self._held[name].attach(fds[0], channels)
                if was_held:
                    self._stop_held()
            case driver_verbs.NodeStop() | driver_verbs.NodeReset():
                self._stops.heed()  # a reset that came before it must not come after it
                self._stop_or_reset(message, self._blocks[message.block])
            case _:
                raise NotImplementedError(f"{type(message).__name__} is not served")

    def _stop_or_reset(self, order: driver_verbs.NodeStop | driver_verbs.NodeReset, block: AnyBlock) -> None:
        is_over = order.resets != self._latch.resets  # the workcell has been reset since then
        if isinstance(order, driver_verbs.NodeStop):
            stop = self._stops.stop_in_passing if is_over else self._stops.stop_node
            stop(block, order.channels, order.bit, order.source, order.at_ns)
        elif not is_over:
            self._stops.reset_for_daemon(block, order.channels, order.bit, order.source, order.at_ns, order.sent_ns)
