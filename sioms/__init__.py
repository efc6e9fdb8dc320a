"""SIOMS: the devices of a workcell behind one small interface, that of UNIX device files.

    import sioms

    with sioms.Workcell() as cell, cell.open("mod0", "rw") as mod0:
        mod0.move(0.1, axis=0, time=0.5)
        mod0.wait_until_idle(timeout=2.0)
        print(mod0.read().position)

Names are loaded when they are first used, so that a program pays only for what it needs.
"""

import sys as _sys

if getattr(_sys, "argv", [])[:1] == ["-m"] and any(word.split(".")[0] == "sioms" for word in _sys.orig_argv):
    from .safe_path import leave_working_directory

    leave_working_directory()  # a module of ours is being run by its name

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .client.command import command as command
    from .client.fleet import Fleet as Fleet
    from .client.fleet import FleetMarker as FleetMarker
    from .client.fleet_verbs import FleetError as FleetError
    from .client.node import AnalogNode as AnalogNode
    from .client.node import AxisNode as AxisNode
    from .client.node import BinaryNode as BinaryNode
    from .client.node import Node as Node
    from .client.node import select as select
    from .client.node_core import EdgesLost as EdgesLost
    from .client.node_core import Event as Event
    from .client.workcell import Marker as Marker
    from .client.workcell import Workcell as Workcell
    from .protocol.flags import AnalogStatus as AnalogStatus
    from .protocol.flags import AxisStatus as AxisStatus
    from .protocol.flags import ControlMode as ControlMode
    from .protocol.flags import NodeClass as NodeClass
    from .protocol.flags import Request as Request

_HOME = {
    "Workcell": "client.workcell",
    "Marker": "client.workcell",
    "Fleet": "client.fleet",
    "FleetMarker": "client.fleet",
    "FleetError": "client.fleet_verbs",
    "Node": "client.node",
    "AxisNode": "client.node",
    "AnalogNode": "client.node",
    "BinaryNode": "client.node",
    "Event": "client.node_core",
    "EdgesLost": "client.node_core",
    "select": "client.node",
    "command": "client.command",
    "ControlMode": "protocol.flags",
    "AxisStatus": "protocol.flags",
    "AnalogStatus": "protocol.flags",
    "NodeClass": "protocol.flags",
    "Request": "protocol.flags",
}
__all__ = [*_HOME]  # noqa: PLE0604  # names of the table above


def __getattr__(name: str) -> object:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module sioms has no attribute {name}; it has: {', '.join(_HOME)}")
    from importlib import import_module

    value = getattr(import_module(f"sioms.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
