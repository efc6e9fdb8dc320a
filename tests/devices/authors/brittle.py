"""A driver that dies on noise: it takes whatever comes for a number."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

from sioms.sdk.exchange import Exchange

_spec = importlib.util.spec_from_file_location("scale_of_brittle", Path(__file__).with_name("scale.py"))
scale = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = scale
_spec.loader.exec_module(scale)


def load() -> Exchange:
    return Exchange(b"W\r", scale.want, lambda reply: float(reply.partition(b"*")[0]), 0.2, True, "read the load")


scale.load = load
DRIVER = scale.Scale
