"""Binary inputs: edges at their exact instant, in order, none lost."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.plant.binary import Beam, Box, Edge, Gripper, SquareWave, beams_record
from sioms.plant.binary_step import look

MS = 1_000_000


def test_edge_is_interpolated_between_samples():
    beam = Beam([Box(((0, 0.010, 0.020),))])
    assert beam.sample([0.0], 5 * MS) == []
    assert beam.sample([0.016], 7 * MS) == [Edge(5 * MS + 1_250_000, True)]
    assert beam.sample([0.016], 9 * MS) == []
    assert beam.sample([0.024], 11 * MS) == [Edge(10 * MS, False)]
    assert not beam.broken


def test_thin_object_gives_both_edges_in_one_tick():
    beam = Beam([Box(((0, 0.4, 0.5),)), Box(((0, 0.7, 0.8),))])
    beam.sample([0.0], 0)
    edges = beam.sample([1.0], 1000)
    assert edges == [Edge(400, True), Edge(500, False), Edge(700, True), Edge(800, False)]
    assert beam.sample([0.0], 2000)[0] == Edge(1200, True)


def test_beam_needs_all_coordinates_of_a_box():
    beam = Beam([Box(((0, 0.2, 0.8), (1, -1.0, 0.5)))])
    beam.sample([0.0, 1.0], 0)
    # x enters at 0.2, z comes below 0.5 half-way: only then is the beam broken.
    assert beam.sample([0.6, 0.0], 1000) == [Edge(500, True)]
    assert beam.sample([0.6, 0.6], 2000) == [Edge(1000 + 833, False)]


def test_grazing_a_corner_breaks_nothing():
    beam = Beam([Box(((0, 0.0, 1.0), (1, 0.0, 1.0)))])
    beam.sample([-1.0, 0.0], 0)
    assert beam.sample([1.0, 2.0], 1000) == [] and not beam.broken


def test_overlapping_boxes_are_one_object():
    beam = Beam([Box(((0, 0.1, 0.5),)), Box(((0, 0.4, 0.9),))])
    beam.sample([0.0], 0)
    assert beam.sample([1.0], 1000) == [Edge(100, True), Edge(900, False)]


@given(st.lists(st.floats(-1, 1).map(lambda v: round(v, 3)), min_size=2, max_size=30))
def test_any_path_gives_alternating_ordered_edges_and_the_right_level(path):
    beam = Beam([Box(((0, -0.25, 0.1),)), Box(((0, 0.3, 0.305),))])
    level, last = False, 0
    for tick, position in enumerate(path):
        for edge in beam.sample([position], tick * 1000):
            assert edge.level != level and last <= edge.stamp_ns <= tick * 1000
            level, last = edge.level, edge.stamp_ns
        assert beam.broken == level == (-0.25 <= position <= 0.1 or 0.3 <= position <= 0.305)


def test_a_quick_look_finds_nothing_only_where_nothing_is():
    rng, quiet = np.random.default_rng(3), 0
    for world in range(40):
        beams = [
            Beam([
                Box(tuple((c, *sorted(rng.integers(0, 9, 2) / 8)) for c in rng.choice(2, rng.integers(1, 3), False)))
                for _ in range(rng.integers(1, 4))
            ])
            for _ in range(rng.integers(1, 4))
        ]  # fmt: skip
        record, place = beams_record(beams, 2), rng.random(2)
        for tick in range(200):
            place = place if rng.random() < 0.2 else np.clip(place + rng.choice([0.0, 0.01, 0.125, -0.125], 2), 0, 1)
            for coordinate in range(2):
                record.now[coordinate] = place[coordinate]
            looked = tick and not look(record, tick)
            edges = [edge for beam in beams for edge in beam.sample(place.tolist(), tick)]
            assert not (looked and edges), f"world {world}, tick {tick}"
            quiet += bool(looked)
            if not looked:
                record.looked_ns = tick
                for k, beam in enumerate(beams):
                    record.broken[k] = beam.broken
                for coordinate in range(2):
                    record.before[coordinate] = place[coordinate]
            assert list(record.before) == place.tolist() and record.looked_ns == tick
    assert quiet > 4000, "and mostly that is seen"


def test_square_wave_edges_match_its_level_however_cut():
    wave = SquareWave(period_ns=70, high_ns=30, start_ns=100, count=5)
    whole = wave.edges(0, 1000)
    assert len(whole) == 10 and whole[0] == Edge(100, True) and whole[-1] == Edge(100 + 4 * 70 + 30, False)
    cuts = [0, 99, 100, 101, 129, 130, 333, 334, 400, 1000]
    assert [e for a, b in itertools.pairwise(cuts) for e in wave.edges(a, b)] == whole
    for edge in whole:
        assert wave.level(edge.stamp_ns) == edge.level and wave.level(edge.stamp_ns - 1) != edge.level


def test_gripper_closes_after_delay_and_travel():
    jaws = Gripper(delay_ns=10, travel_ns=100)
    assert jaws.sample(0) == ([], []) and jaws.opened
    jaws.command(True, 20)
    assert jaws.sample(50) == ([], [Edge(30, False)])
    assert jaws.opening == pytest.approx(0.8)
    assert jaws.sample(200) == ([Edge(130, True)], [])
    assert jaws.closed and jaws.opening == 0.0


def test_gripper_turned_round_in_mid_travel():
    jaws = Gripper(delay_ns=10, travel_ns=100)
    jaws.sample(0)
    jaws.command(True, 0)
    jaws.command(False, 40)
    assert jaws.sample(300) == ([], [Edge(10, False), Edge(50 + 40, True)])


def test_object_keeps_the_jaws_from_the_closed_switch():
    jaws = Gripper(delay_ns=0, travel_ns=100, object_at=0.3)
    jaws.sample(0)
    jaws.command(True, 0)
    assert jaws.sample(1000) == ([], [Edge(0, False)])
    assert jaws.opening == 0.3 and not jaws.closed
    jaws.command(False, 1000)
    assert jaws.sample(2000) == ([], [Edge(1070, True)])


def test_gripper_refuses_bad_numbers():
    with pytest.raises(ValueError, match="travel"):
        Gripper(0, 0)
    assert np.isfinite(Gripper(0, 1).opening)
