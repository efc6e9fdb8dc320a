"""No module of the product imports, by whatever way round, what imports it: not for types either."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter

import grimp
import pytest


def imports() -> dict[str, set[str]]:
    """Return what each module imports of the product: anywhere in it, also in a function or for types alone."""
    graph = grimp.build_graph("sioms", exclude_type_checking_imports=False, cache_dir=None)
    return {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}


def test_modules_import_each_other_in_no_ring() -> None:
    found = imports()
    assert len(found) > 500
    try:
        TopologicalSorter(found).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))
