"""Find where simulation and measurement disagree, name the missing effect, add it, show the gap shrink.

The library face, alike for axes, tactile fingers, force sensors and hands: read data and model, analyse, report.

>>> from pathlib import Path
>>> from sioms import reconcile
>>> def correct(folder: Path) -> str:
...     model = reconcile.read_model(folder / "nominal.toml")
...     verdict = reconcile.analyse(reconcile.read_data(folder, model), model)
...     reconcile.write_report(verdict, folder / "report")
...     return verdict.outcome.value

All numbers are SI: m or rad, N or N m, s. Everything is deterministic by the seed, and whatever is wrong with data or
model raises ``BadInputError`` with a sentence that says what was read, what is wrong and what would be right. Set
``OPENBLAS_NUM_THREADS=1`` before numpy is imported: the matrices are small, and several threads take three times as
long. What is not used is not loaded: a name is imported when it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sioms.reconcile.axis import analyse
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.files.axis import read_data, read_model
    from sioms.reconcile.files.finger import reconcile_tactile
    from sioms.reconcile.files.force import reconcile_force
    from sioms.reconcile.files.hand import reconcile_hand
    from sioms.reconcile.model import AxisModel, Controller
    from sioms.reconcile.model_file import write_model
    from sioms.reconcile.prepare import Options
    from sioms.reconcile.records import Record, Session
    from sioms.reconcile.report import write_report
    from sioms.reconcile.verdict import Estimate, Gap, NamedEffect, Outcome, Place, Verdict

__all__ = [
    "AxisModel", "BadInputError", "Controller", "Estimate", "Gap", "NamedEffect", "Options", "Outcome", "Place",
    "Record", "Session", "Verdict", "analyse", "read_data", "read_model", "reconcile_force", "reconcile_hand",
    "reconcile_tactile", "write_model", "write_report",
]  # fmt: skip

_WHERE = {
    "axis": ("analyse",),
    "errors": ("BadInputError",),
    "files.axis": ("read_data", "read_model"),
    "files.finger": ("reconcile_tactile",),
    "files.force": ("reconcile_force",),
    "files.hand": ("reconcile_hand",),
    "model": ("AxisModel", "Controller"),
    "model_file": ("write_model",),
    "prepare": ("Options",),
    "records": ("Record", "Session"),
    "report": ("write_report",),
    "verdict": ("Estimate", "Gap", "NamedEffect", "Outcome", "Place", "Verdict"),
}
_MODULES = {name: f"{__name__}.{module}" for module, names in _WHERE.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
