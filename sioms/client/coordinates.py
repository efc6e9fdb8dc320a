"""One axis in the user's own coordinates: another zero, another direction.

The coordinates of a node are shared by all its clients: raw is what the device counts, CALIBRATE_DEVICE and
homing set the offset from it. User coordinates are this client's own view of them and change nothing in the driver,
except by ``calibrate`` and ``zero``.

Concurrency: as the node that it looks at.
"""

from __future__ import annotations

from sioms.protocol.flags import AxisStatus

from .arguments import integer, number
from .faces import Awaiting, Blocking
from .marks import verb
from .node_verbs import AxisVerbs

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

_SIGNED = ("velocity", "acceleration", "jerk", "force", "force_velocity", "force_offset")


class UserAxisVerbs:
    """An axis of an open node, seen as ``user = direction * position + offset``.

    Positions and steps are in the axis' unit (m or rad), velocities in it per second and so on, forces in N or N*m, all
    in this view's direction. Readings raise OSError as ``read`` does (EIO the device is lost), verbs as the node's.

    Args:
        node: open axis node.
        axis: index of the axis in the node.
        offset: user coordinate of the node's position 0 [unit].
        direction: 1, or -1 when user coordinates grow against the axis.

    Raises:
        ValueError: another direction.

    Example:
        >>> UserAxis(None, 0, 0.5, -1).to_node(0.2)
        0.3
    """

    def __init__(self, node: AxisVerbs, axis: int = 0, offset: float = 0.0, direction: int = 1) -> None:
        if integer("make user coordinates: direction", direction, "1 or -1") not in (1, -1):
            raise ValueError(f"make user coordinates: direction {direction!r}; want 1 or -1")
        self.node, self.axis, self.direction = node, axis, direction
        self.offset = number("make user coordinates: offset", offset)

    def __repr__(self) -> str:
        channel = self.node.info.channels[self.axis]
        view = "" if (self.offset, self.direction) == (0.0, 1) else f", {self.direction:+d} * position {self.offset:+g}"
        try:
            place = f"at {self.position:.6g} {channel.unit}"
        except OSError as error:
            place = error.strerror or str(error)
        return f"<{type(self).__name__} {self.node.name}[{channel.name!r}]{view}: {place}>"

    def to_node(self, user: float) -> float:
        """Return the node's position of a user position [unit]."""
        return (number("turn a user position", user) - self.offset) * self.direction

    def to_user(self, position: float) -> float:
        """Return the user position of one of the node's [unit]."""
        return self._turn(position) + self.offset

    @property
    def position(self) -> float:
        """The measured position [unit]."""
        return self.to_user(self.node.read().position[self.axis])

    @property
    def velocity(self) -> float:
        """The measured velocity [unit/s]."""
        velocity: float = self.node.read().velocity[self.axis]
        return self.direction * velocity

    @property
    def force(self) -> float:
        """The measured force or torque [N or N*m]."""
        force: float = self.node.read().force[self.axis]
        return self.direction * force

    @property
    def status(self) -> AxisStatus:
        """The status word; limits and switches are those of the node's own direction."""
        return AxisStatus(int(self.node.read().status[self.axis]))

    @property
    def in_motion(self) -> bool:
        """Whether the axis moves, or is on its way to a target."""
        return bool(self.node.read().in_motion[self.axis])

    def call_here(self, user: float) -> None:
        """Let the present place have this user coordinate [unit]; nothing moves, and no other client sees it."""
        self.offset = (
            number("call a place by a user coordinate", user) - self.direction * self.node.read().position[self.axis]
        )

    @verb
    async def limits(self) -> tuple[float | None, float | None]:
        """Return the lowest and highest user position [unit], None where there is no soft limit."""
        found = await AxisVerbs.limits(self.node)
        low, high = (found[name][self.axis] for name in ("position_min", "position_max"))
        ends = [None if end is None else self.to_user(end) for end in (low, high)]
        return (ends[0], ends[1]) if self.direction > 0 else (ends[1], ends[0])

    @verb
    async def move(
        self, /, position: float, *, replace: bool = False, timeout: float | None = 0.0, **words: Any
    ) -> int:
        """Append a command to a user position [unit]; further words of ``sioms.command`` in user coordinates."""
        place = self._turn(position) if words.get("relative") else self.to_node(position)
        words = self._turned(words)
        return await AxisVerbs.move(self.node, place, self.axis, replace=replace, timeout=timeout, **words)

    @verb
    async def tweak(self, /, step: float, **words: Any) -> int:
        """Append a step [unit] from where the preceding command ends."""
        return await AxisVerbs.tweak(self.node, self._turn(step), self.axis, **self._turned(words))

    @verb
    async def jog(self, velocity: float, *, acceleration: float | None = None) -> int:
        """Go over to a velocity [unit/s], with at most so much acceleration [unit/s^2]; see ``AxisNode.jog``."""
        return await AxisVerbs.jog(self.node, self._turn(velocity), self.axis, acceleration=acceleration)

    @verb
    async def command(self, /, *, timeout: float | None = 0.0, replace: bool = False, **words: Any) -> int:
        """Append a command; the words of ``sioms.command`` in user coordinates."""
        words = self._turned(words)
        if "position" in words:
            turn = self._turn if words.get("relative") else self.to_node
            words["position"] = turn(words["position"])
        return await AxisVerbs.command(self.node, self.axis, timeout=timeout, replace=replace, **words)

    @verb
    async def stop(self) -> None:
        """Stop this axis at maximum deceleration and empty its buffer; not latched."""
        await AxisVerbs.stop(self.node, self.axis)

    @verb
    async def wait_until_idle(self, timeout: float | None = None) -> None:
        """Wait until this axis stands still and its buffer is empty; see ``AxisNode.wait_until_idle``."""
        await AxisVerbs.wait_until_idle(self.node, timeout, self.axis)

    @verb
    async def home(self) -> None:
        """Start homing this axis; ``wait_until_idle`` waits for its end."""
        await AxisVerbs.home(self.node, self.axis)

    @verb
    async def zero(self) -> None:
        """Make the present position 0 in these coordinates, for all clients; see ``calibrate``."""
        await UserAxisVerbs.calibrate(self, 0.0)

    @verb
    async def calibrate(self, user: float) -> None:
        """Give the present position a new value [unit], for all clients, without motion; other axes keep theirs.

        ``call_here`` changes these coordinates alone.
        """
        places: list[float | None] = [None] * len(self.node.info.channels)
        places[self.axis] = self.to_node(user)
        await AxisVerbs.calibrate(self.node, *places)

    def _turn(self, value: float) -> float:
        return self.direction * number("turn user coordinates", value)

    def _turned(self, words: dict[str, Any]) -> dict[str, Any]:
        return {name: self._turn(word) if name in _SIGNED else word for name, word in words.items()}


class UserAxis(Blocking, UserAxisVerbs):
    __doc__ = UserAxisVerbs.__doc__


class AsyncUserAxis(Awaiting, UserAxisVerbs):
    __doc__ = UserAxisVerbs.__doc__
