"""The state of a workcell: what is configured, which devices there are, and what all parts of the daemon use.

Below everything that acts on it: stops, alarms, clients, processes and the server that joins them.
"""

from __future__ import annotations

from sioms.timestamps import Timestamps

from .config import Config, QuotaTable, WorkcellTable
from .devices import DriverProcess
from .log import Log
from .loop import Loop
from .names import NameTable
from .quotas import Quotas
from .shared import Shared


class Cell:
    """What is there, for all who act on it.

    Concurrency: everything runs in the daemon's loop.

    Args:
        loop: the loop it lives in.
        log: its log.
        shared: what all driver processes share: latch, stop files, markers, the record of stops.

    Attributes:
        config: the configuration in force; None until the first one is taken up.
        names: the nodes of that configuration.
        timestamps: tell when something was sent.
        devices: by name.
        leaving: devices of before that are ending, by name.
        watched_inputs: for each device the blocks with emergency-stop inputs that must be readable, and the node of
            one.
    """

    def __init__(self, loop: Loop, log: Log, shared: Shared) -> None:
        self.loop = loop
        self.log = log
        self.shared = shared
        self.timestamps = Timestamps()
        self.config: Config | None = None
        self.names = NameTable({}, {})
        self.devices: dict[str, DriverProcess] = {}
        self.leaving: dict[str, DriverProcess] = {}
        self.watched_inputs: dict[str, dict[int, str]] = {}

    @property
    def bounds(self) -> WorkcellTable:
        """``[workcell]`` of the configuration."""
        return self.config.workcell if self.config else WorkcellTable()

    @property
    def quotas(self) -> Quotas:
        """The quotas of the configuration."""
        return Quotas(self.config.quota if self.config else QuotaTable())

    def is_replaced(self, name: str) -> bool:
        """Tell whether a device is leaving and starts again, as configured now, when it has left."""
        return name in self.leaving and self.config is not None and name in self.config.devices
