"""Force/torque sensor models as TOML text.

[sensor]
name = "wrist"
components = ["fx", "fy", "fz", "tx", "ty", "tz"]
full_range = [100.0, 100.0, 200.0, 8.0, 8.0, 8.0]   # N, N m
matrix = [[1.0, 0.0, ...], ...]                     # reading per load; default: the identity
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.force.belief import ForceBelief
from sioms.reconcile.force.effects import library
from sioms.reconcile.given import only, table_in, words
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.model_file import effects_from, effects_to_toml, numbers

KEYS = ("name", "components", "full_range", "matrix")


def from_table(table: Mapping[str, Any], where: str) -> tuple[SensorModel, tuple[str, ...]]:
    """Build a model from the tables [sensor] and [effects.*]; return it with the names of the components.

    Raises:
        BadInputError: a key is missing, unknown or makes no sense.
    """
    if set(table) - {"sensor", "effects"} or "sensor" not in table:
        raise BadInputError(
            f"read model {where}: needs the tables sensor and effects; got {', '.join(sorted(table)) or 'nothing'}"
        )
    t = table_in(table, "sensor", f"read model {where}")
    only(t, KEYS, f"read model {where}, [sensor]")
    names = words(t, "components", f"read model {where}, [sensor]", "different names") or ()
    if not names or len(set(names)) != len(names):
        raise BadInputError(
            f"read model {where}: components is {t.get('components')!r}; needs a list of different names"
        )
    count = len(names)
    full = numbers(t, "full_range", where, count)
    if not np.all(full > 0.0):
        raise BadInputError(f"read model {where}: full_range holds {float(full.min()):g}; needs N and N m, > 0")
    matrix = np.eye(count)
    if "matrix" in t:
        try:
            matrix = np.asarray(t["matrix"], dtype=np.float64)
        except (TypeError, ValueError) as e:
            raise BadInputError(
                f"read model {where}: matrix holds what is not a number, or rows of different lengths"
            ) from e
        if matrix.shape != (count, count) or not np.isfinite(matrix).all():
            raise BadInputError(
                f"read model {where}: matrix has shape {matrix.shape}; needs ({count}, {count}), finite"
            )
    belief = ForceBelief(names, full, matrix * full[None, :] / full[:, None])
    model = SensorModel(belief, count, library(names), {}, (), str(t.get("name", "sensor")))
    return effects_from(model, table, where), names


def to_toml(model: SensorModel) -> str:
    """Write a model: nominal sensor and effects."""
    b: ForceBelief = model.base
    matrix = b.matrix * b.full[:, None] / b.full[None, :]
    rows = ",\n".join("  [" + ", ".join(repr(float(v)) for v in row) + "]" for row in matrix)
    lines = [
        "[sensor]",
        f'name = "{model.name}"',
        "components = [" + ", ".join(f'"{n}"' for n in b.names) + "]",
        "full_range = [" + ", ".join(repr(float(v)) for v in b.full) + "]",
        f"matrix = [\n{rows},\n]",
    ]
    return "\n".join(lines) + "\n" + effects_to_toml(model)
