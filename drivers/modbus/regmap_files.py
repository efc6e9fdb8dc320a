"""Read register maps from files: all errors of a map at once, each with the place and what would be right."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from sioms.documents import read_bytes, toml_of
from sioms.wording import did_you_mean

from .regmap import RegisterMap
from .regmap_check import meaning_problems, schema_problems


class RegisterMapError(ValueError):
    """A map is wrong.

    Attributes:
        problems: one sentence each, with the place in the file.
    """

    def __init__(self, where: str, problems: list[str]) -> None:
        super().__init__("\n".join(f"read register map {where}: {problem}" for problem in problems))
        self.problems = problems


def parse_map(document: Mapping[str, Any], where: str) -> RegisterMap:
    """Return the checked map.

    Raises:
        RegisterMapError: with all problems of the document.
    """
    problems = schema_problems(document, RegisterMap)
    if not problems:
        result = msgspec.convert(document, RegisterMap)
        problems = meaning_problems(result)
        if not problems:
            return result
    raise RegisterMapError(where, problems)


def named_map(name: str, shipped: Path, overrides: Mapping[str, Any] | None = None) -> RegisterMap:
    """Return a shipped map by its name, or one of the user's by the path of its file, which ends in .toml.

    Args:
        name: as configured.
        shipped: folder of the shipped maps.
        overrides: as of ``load_map``.

    Raises:
        RegisterMapError: there is no such map, or it is wrong.
    """
    if name.endswith(".toml"):
        return load_map(Path(name), overrides)
    known = sorted(path.stem for path in shipped.glob("*.toml"))
    if name not in known:
        problem = (
            f"no shipped map has this name{did_you_mean(name, known)}; one of your own is a path that ends in .toml"
        )
        raise RegisterMapError(name, [problem])
    return load_map(shipped / f"{name}.toml", overrides)


def load_map(path: Path, overrides: Mapping[str, Any] | None = None) -> RegisterMap:
    """Return the map in a TOML file, with the keys of ``overrides`` put over it.

    Raises:
        RegisterMapError: unreadable or wrong.
    """
    try:
        document = toml_of(read_bytes(path))
    except OSError as error:
        raise RegisterMapError(str(path), [(error.strerror or str(error)).lower()]) from None
    except ValueError as error:
        raise RegisterMapError(str(path), [f"no TOML: {error}"]) from None
    return parse_map(_merged(document, overrides or {}), str(path))


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(below)
    for key, value in above.items():
        old = result.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        result[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return result
