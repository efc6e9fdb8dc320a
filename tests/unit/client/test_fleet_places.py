"""The file of a fleet, and starts of several cells by what is known of their clocks."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.client.fleet_places import claim, read, wanted
from sioms.protocol.clock import UNKNOWN_NS, Clock, Source, Wall, starts


def test_the_file(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text('[cells]\nleft = "zenoh://lab1:5780"\n')
    assert read(str(file)) == {"left": "zenoh://lab1:5780"} and wanted(str(file)) == [("left", "zenoh://lab1:5780")]
    for text in (
        "[cells",
        "[cells]\nleft = 5\n",
        '[cells]\n[more]\nx = "y"\n',
        "",
        '[cells]\na = "x"\na = "y"\n',
        "\xff",
    ):
        file.write_bytes(text.encode("latin-1"))
        with pytest.raises(OSError, match="read the fleet"):
            read(str(file))
    with pytest.raises(OSError, match="no such file; write one"):
        read(str(tmp_path / "none"))
    with pytest.raises(OSError, match="want a name without"):
        wanted({"a:b": "x"})
    assert wanted(["x", "y"]) == [("", "x"), ("", "y")]


def test_claims() -> None:
    assert claim("", "left", "x", {}) == claim("left", "left", "x", {}) == "left"
    with pytest.raises(OSError, match="calls itself 'left' and the fleet 'right'"):
        claim("right", "left", "x", {})
    with pytest.raises(OSError, match="as does the one at y"):
        claim("", "left", "x", {"left": "y"})


class Known(Clock):
    """A clock whose offset is known so well."""

    def __init__(self, offset_ns: int, error_ns: int, wall: Wall | None = None) -> None:
        self._offset_ns, self._error_ns, self.wall = offset_ns, error_ns, wall

    @property
    def offset_ns(self) -> int:
        return self._offset_ns

    @property
    def error_ns(self) -> int:
        return self._error_ns


@given(
    true=st.lists(st.integers(-(10**15), 10**15), min_size=2, max_size=5),
    errors=st.lists(st.tuples(st.integers(0, 10**6), st.integers(-1000, 1000)), min_size=5, max_size=5),
    walls=st.lists(st.tuples(st.integers(0, 10**6), st.integers(-1000, 1000)), min_size=5, max_size=5),
)
def test_cells_are_no_further_apart_than_is_told(
    true: list[int], errors: list[tuple[int, int]], walls: list[tuple[int, int]]
) -> None:
    """Whatever the errors are within what is stated of them."""
    utc_ahead_ns = 10**18
    clocks = {
        str(i): Known(
            offset + error * part // 1000, error, Wall(utc_ahead_ns - offset + wall * other // 1000, wall, Source.PTP)
        )
        for i, (offset, (error, part), (wall, other)) in enumerate(zip(true, errors, walls, strict=False))
    }
    there, bound_ns, by = starts(5_000, clocks, 10**9)
    here = [at - offset for at, offset in zip(there.values(), true, strict=True)]
    assert max(here) - min(here) <= bound_ns + 2
    assert by in ("UTC", "links") and bound_ns <= 2 * 10**6
    if bound_ns:
        with pytest.raises(ValueError, match="apart, more than"):
            starts(5_000, clocks, bound_ns - 1)


def test_one_cell_is_not_apart_and_an_unknown_clock_is_none() -> None:
    one = Known(7, 10**6)
    assert starts(100, {"a": one}, 0) == ({"a": 107}, 0, "links")
    with pytest.raises(ValueError, match="a unknown and unknown"):
        starts(100, {"a": Known(7, UNKNOWN_NS), "b": one}, 10**6)
