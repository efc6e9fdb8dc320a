"""Every example in a docstring is run."""

import doctest
import importlib
import inspect
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parents[2]


def modules_with_examples():
    """Return the names of all modules of the packages that hold a ``>>>``."""
    found = []
    for top, prefix in (("sioms", ""), ("daemon", "sioms."), ("drivers", "sioms."), ("tools", "sioms.")):
        for path in sorted((TREE / top).rglob("*.py")):
            if ">>> " in path.read_text():
                parts = path.relative_to(TREE).with_suffix("").parts
                found.append(prefix + ".".join(part for part in parts if part != "__init__"))
    return found


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_give_what_they_say(name):
    module = importlib.import_module(name)
    result = doctest.testmod(module, optionflags=doctest.ELLIPSIS)
    assert result.attempted > 0, f"{inspect.getfile(module)} holds >>> but no example that is found"
    assert result.failed == 0
