"""Nodes as devices of bluesky, to be moved, read and flown by plans of its RunEngine.

    from sioms.bridges.bluesky import Axis, Detector, FlyScan, Output

They follow the protocols of ``bluesky.protocols``, and import nothing of bluesky themselves.
"""

from .devices import Axis, Detector, Output
from .flying import FlyScan
from .status import Status

__all__ = ["Axis", "Detector", "FlyScan", "Output", "Status"]
