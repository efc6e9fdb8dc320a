"""The verb table of daemon, drivers and fork server; see ``verbs``."""

from __future__ import annotations

from .verbs import Message, Socket

TYPE_CHECKING = False
if TYPE_CHECKING:
    from enum import IntEnum

    from .verbs import Array, Flag, Integer, Table, Text
else:
    from .enumeration import IntEnum


class DriverVerb(IntEnum):
    """Between the daemon and a driver, on its control socket."""

    ATTACH = 1
    DETACH = 2
    STOP_CHANGED = 3
    SHUTDOWN = 4
    INPUT = 5
    NODE_STOP = 6
    NODE_RESET = 7
    IN_USE = 8
    HELD = 9
    READY = 20
    DETACHED = 21
    MARKER_SIGNALLED = 22
    STOPPED = 23
    LINK = 24
    LOG = 25
    ALARM = 26
    HELD_SILENT = 27
    STOPS_SHOWN = 28


class ForkServerVerb(IntEnum):
    """Between the daemon and the fork server."""

    DESCRIBE = 1
    SPAWN = 2


# --- from the daemon to a driver -----------------------------------------------------------------

TO_DRIVER = Socket("daemon", "driver", ("starting", "up", "ending"))


class Attach(Message, on=TO_DRIVER, verb=DriverVerb.ATTACH, notice=True, states=("up",)):
    """Serve a handle; descriptors: its socket, the writing end of the wake pipe, and the client's pidfd if
    any.
    """

    handle: Integer
    block: Integer
    channels: Array
    bit: Integer
    access: Integer
    exclusive: Flag
    rights: Integer
    lease_ns: Integer
    who: Text
    uid: Integer
    quota: Array
    node: Text


class Detach(Message, on=TO_DRIVER, verb=DriverVerb.DETACH, notice=True, states=("up", "ending")):
    """End a handle, as if its socket had closed, and say why; no reason: its client has closed it."""

    handle: Integer
    errno: Integer
    reason: Text


class StopChanged(Message, on=TO_DRIVER, verb=DriverVerb.STOP_CHANGED, notice=True):
    """The latch has changed: read it at once."""


class Shutdown(Message, on=TO_DRIVER, verb=DriverVerb.SHUTDOWN, notice=True, then="ending"):
    """Stop, make outputs safe, exit."""


class Input(Message, on=TO_DRIVER, verb=DriverVerb.INPUT, notice=True, states=("up", "ending")):
    """A node that the driver reads is available; descriptor: its page."""

    name: Text
    channels: Array
    bit: Integer


class NodeStop(Message, on=TO_DRIVER, verb=DriverVerb.NODE_STOP, notice=True):
    """Emergency stop of some channels, or of one bit of them (-1: all).

    ``resets`` is how often the workcell had been reset; after a later reset what moves stops, and is not latched.
    ``at_ns`` is when it was sent: what clients have sent before to reset these channels is not taken any more.
    """

    block: Integer
    channels: Array
    bit: Integer
    source: Text
    resets: Integer
    at_ns: Integer


class NodeReset(Message, on=TO_DRIVER, verb=DriverVerb.NODE_RESET, notice=True):
    """Clear the stop and the faults of some channels; void when the workcell has been reset since.

    ``at_ns`` is when it was sent: what clients have sent before to what was stopped is not taken any more. ``sent_ns``
    is when somebody has asked the daemon for it, at the earliest: it undoes no stop that was asked for later.
    """

    block: Integer
    channels: Array
    bit: Integer
    source: Text
    resets: Integer
    at_ns: Integer
    sent_ns: Integer


class InUse(Message, on=TO_DRIVER, verb=DriverVerb.IN_USE, notice=True):
    """Whether somebody reads this device through another one; a device of whom nobody reads may tick seldom."""

    used: Flag


class Held(Message, on=TO_DRIVER, verb=DriverVerb.HELD, notice=True, states=("up", "ending")):
    """A node that this device holds is its own from now on; descriptor: the socket of its handle.

    ``channels`` are packed as ChannelInfo.
    """

    name: Text
    channels: Array


# --- from a driver to the daemon -----------------------------------------------------------------

FROM_DRIVER = Socket("driver", "daemon", TO_DRIVER.states)


class Ready(Message, on=FROM_DRIVER, verb=DriverVerb.READY, notice=True, states=("starting", "ending"), then="up"):
    """Publishing has begun; descriptors: one page a block, writable until the daemon seals it."""

    blocks: Integer


class Detached(Message, on=FROM_DRIVER, verb=DriverVerb.DETACHED, notice=True, states=("up", "ending")):
    """The axes of a handle are being halted; its channels are free."""

    handle: Integer


class MarkerSignalled(Message, on=FROM_DRIVER, verb=DriverVerb.MARKER_SIGNALLED, notice=True):
    """A command has signalled a marker."""

    number: Integer


class Stopped(Message, on=FROM_DRIVER, verb=DriverVerb.STOPPED, notice=True):
    """The driver stops the workcell, and could not write the stop-request file."""

    source: Text


class StopsShown(Message, on=FROM_DRIVER, verb=DriverVerb.STOPS_SHOWN, notice=True):
    """Since when somebody may know of the stops by alarms that the driver has noted: told before anybody does. A reset
    that was sent earlier leaves them.
    """

    at_ns: Integer


class LinkChanged(Message, on=FROM_DRIVER, verb=DriverVerb.LINK, notice=True):
    """The state of the link to the device: a PageState, and the reason."""

    state: Integer
    reason: Text


class AlarmChanged(Message, on=FROM_DRIVER, verb=DriverVerb.ALARM, notice=True):
    """What a channel's alarm is now, of one bit of it (-1: all): a Severity, and why. ``what`` is the column that is
    watched, or "fault".

    ``at_ns``, of a fault: since when somebody may know of it; it is told before anybody does. A reset that was sent
    earlier leaves it.
    """

    block: Integer
    channel: Integer
    bit: Integer
    what: Text
    severity: Integer
    text: Text
    at_ns: Integer


class HeldSilent(Message, on=FROM_DRIVER, verb=DriverVerb.HELD_SILENT, notice=True):
    """A node that this device holds takes no orders from it: it is to be stopped, and taken from it."""

    name: Text
    why: Text


class LogLine(Message, on=FROM_DRIVER, verb=DriverVerb.LOG, notice=True):
    """A line for the daemon's log."""

    level: Text
    text: Text


# --- from the daemon to the fork server ----------------------------------------------------------

TO_FORK_SERVER = Socket("daemon", "fork server", ("serving",))


class Describe(Message, on=TO_FORK_SERVER, verb=ForkServerVerb.DESCRIBE, query=True):
    """Check the settings of a device and describe it. Answer: [errors, description], packed and compressed by zlib."""

    device: Text
    driver: Text
    settings: Table
    folder: Text


class Spawn(Message, on=TO_FORK_SERVER, verb=ForkServerVerb.SPAWN):
    """Fork a driver; descriptors: control socket, latch, stop-request file, file of the requests taken, markers,
    journal.

    Answer: its pid; descriptor: its pidfd.
    """

    device: Text
    driver: Text
    settings: Table
    generation: Integer
    options: Table
