"""Codecs of the force/torque sensors under any cut, any damage and any bytes; numbered records under a bad network."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sioms.drivers.ati_rdt import codec as rdt
from sioms.drivers.ati_rdt import http_get
from sioms.drivers.ft300 import codec as ft300
from sioms.drivers.schunk_ft import codec as ifb
from sioms.sdk.codec.sequence import RESTART_AFTER, SequenceRestart, SequenceWatch
from sioms.sdk.exchange import DeviceError, LinkError

COUNTS = st.tuples(*[st.integers(-32768, 32767)] * 6)
CUTS = st.lists(st.integers(1, 40), min_size=1, max_size=30)
NOISE = st.lists(st.one_of(st.just(ft300.HEAD), st.binary(max_size=20)), max_size=8).map(b"".join)


def cut(data: bytes, sizes: list[int]) -> list[bytes]:
    pieces, at, i = [], 0, 0
    while at < len(data):
        pieces.append(data[at : at + sizes[i % len(sizes)]])
        at += len(pieces[-1])
        i += 1
    return pieces


@given(st.lists(COUNTS, max_size=12), CUTS)
@example([(20000,) * 6] * 3, [1])
def test_any_cut_gives_the_same_records(records: list[tuple[int, ...]], sizes: list[int]) -> None:
    receiver = ft300.RecordReceiver()
    wire = b"".join(map(ft300.build_record, records))
    got = [each for piece in cut(wire, sizes) for each in receiver.feed(piece)]
    assert got == [(counts, False) for counts in records]
    assert receiver.counters == ft300.Counters(records=len(records))


@given(st.lists(st.tuples(NOISE, COUNTS), max_size=6), NOISE, CUTS)
def test_noise_between_records_in_any_cut(
    parts: list[tuple[bytes, tuple[int, ...]]], tail: bytes, sizes: list[int]
) -> None:
    """However the stream is cut, the same is found and counted; what was sent whole after enough quiet is found."""
    data = b"".join(noise + ft300.build_record(counts) for noise, counts in parts) + tail + bytes(16)
    whole, pieces = ft300.RecordReceiver(), ft300.RecordReceiver()
    found = whole.feed(data)
    assert [each for piece in cut(data, sizes) for each in pieces.feed(piece)] == found
    assert whole.counters == pieces.counters and len(pieces._rest) < ft300.RECORD_BYTES
    assert whole.counters.skipped_bytes + 16 * whole.counters.records + len(whole._rest) == len(data)
    assert pieces.feed(bytes(16) + ft300.build_record((1, 2, 3, 4, 5, 6)))[-1][0] == (1, 2, 3, 4, 5, 6)


@given(st.integers(0, 127), COUNTS)
def test_one_damaged_bit_is_seen(bit: int, counts: tuple[int, ...]) -> None:
    record = bytearray(ft300.build_record(counts))
    record[bit // 8] ^= 1 << bit % 8
    assert counts not in [values for values, _ in ft300.RecordReceiver().feed(bytes(record) + bytes(16))]


@given(st.binary(max_size=1600))
def test_datagrams_of_any_bytes(data: bytes) -> None:
    records = rdt.parse(data)
    if records is not None:
        assert b"".join(map(rdt.build, records)) == data
    record = ifb.parse(data)
    if record is not None:
        assert len(data) == ifb.RECORD_BYTES


@given(st.binary(max_size=400), CUTS)
def test_replies_of_any_bytes_raise_only_what_the_kit_takes(noise: bytes, sizes: list[int]) -> None:
    exchanges = [
        rdt.start(rdt.Command.REALTIME, 0.1), ifb.get(ifb.PRODUCT), ifb.act(ifb.Command.STOP),
        http_get.get("h", "/netftapi2.xml", rdt.parse_page, 1.0),
    ]  # fmt: skip
    starts = (b"", b"\xff\xff\x01\x00\x09\x00\xf0\x00", b"HTTP/1.0 200 OK\r\nContent-Length: 30\r\n\r\n")
    for exchange in exchanges:
        for start in starts:
            got = b""
            try:
                for piece in cut(start + noise, sizes):
                    got += piece
                    size = exchange.want(got)
                    if size is not None and len(got) >= size:
                        exchange.decode(got[:size])
                        break
                exchange.decode(got)
            except (LinkError, DeviceError):
                continue


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF))
def test_every_status_has_words(bits: int, word: int) -> None:
    assert ifb.status_text(bits)
    for model in rdt.Model:
        assert rdt.status_text(word, model)
        assert not (word == 0 and rdt.is_invalid(word, model))
        assert rdt.is_invalid(word, model) <= bool(word >> 31)


# --- numbered records -----------------------------------------------------------------------------

RATE_HZ, MS = 1000.0, 1_000_000


@given(
    st.integers(0, 0xFFFF), st.lists(st.sampled_from(["good", "good", "good", "lost", "doubled", "late"]), max_size=120)
)  # fmt: skip
def test_a_bad_network_is_counted_exactly(first: int, fates: list[str]) -> None:
    """Each number is sent once; some are lost, doubled, or overtaken by the next that arrives: the
    counts tell which.
    """
    watch = SequenceWatch(1 << 16, RATE_HZ)
    assert watch.accept(first, 0) is None, "nothing shows that the first one is not old"
    held: list[int] = []
    arrived = ["start"]
    for step, fate in enumerate([*fates, "good"], start=1):
        number, now_ns = (first + step) & 0xFFFF, step * MS
        if fate == "lost":
            continue
        if fate == "late":
            if len(held) < RESTART_AFTER - 2:
                held.append(number)
                continue
            fate = "good"
        lost_before = watch.accept(number, now_ns)
        assert lost_before is not None and lost_before >= 0
        arrived.append(fate)
        if fate == "doubled":
            assert watch.accept(number, now_ns) is None
        for each in held:
            assert watch.accept(each, now_ns) is None
            arrived.append("late")
        held.clear()
    assert watch.lost == fates.count("lost")
    assert watch.late == arrived.count("late")
    assert watch.doubled == arrived.count("doubled")
    assert watch.restarts == 0


@given(st.lists(st.tuples(st.integers(0, 0xFFFF), st.integers(0, 3000)), max_size=200))
def test_any_numbers_keep_the_counts_sane(arrivals: list[tuple[int, int]]) -> None:
    """Nothing is fresh beyond what the sender can have counted in the time, whatever comes."""
    watch = SequenceWatch(1 << 16, RATE_HZ)
    now_ns = fresh = 0
    for number, wait_ms in arrivals:
        now_ns += wait_ms * MS
        with contextlib.suppress(SequenceRestart):
            lost = watch.accept(number, now_ns)
            assert lost is None or 0 <= lost < 1 << 15
            fresh += 0 if lost is None else 1 + lost
    assert watch.lost >= 0 and watch.late >= 0 and watch.doubled >= 0
    assert fresh <= 1.05 * now_ns / MS + RATE_HZ * (1 + watch.restarts)


@given(st.integers(0, 0xFFFFFFFF), st.integers(1, 40))
def test_a_frozen_stream_is_never_fresh(last: int, window: int) -> None:
    """One record sent for ever, or a window of them over and over: a frozen stream is not taken for a restart."""
    watch = SequenceWatch(1 << 32, RATE_HZ)
    numbers = [(last + i) & 0xFFFFFFFF for i in range(window)]
    for i, number in enumerate(numbers):
        watch.accept(number, i * MS)
    for i in range(1000):
        assert watch.accept(numbers[i % window], (window + i) * MS) is None
    assert watch.restarts == 0 and watch.lost == 0
    after = (last + window) & 0xFFFFFFFF
    with contextlib.suppress(SequenceRestart):
        assert watch.accept(after, (window + 1000) * MS) == 0


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), st.integers(0, 200))
def test_a_restart_is_told_and_never_fresh(last: int, first: int, pause_ms: int) -> None:
    """A 16-bit counter that begins elsewhere within the time in which a link is lost: told, unless it passes for a
    gap.
    """
    watch = SequenceWatch(1 << 16, RATE_HZ)
    for i in range(10):
        watch.accept((last - 9 + i) & 0xFFFF, i * MS)
    step = (first - last) & 0xFFFF
    if 0 < step <= RATE_HZ * 1.1 + pause_ms:
        return  # 1.8 % of all places look like lost records
    if -step & 0xFFFF < RESTART_AFTER:
        return  # and a few like doubled ones
    try:
        for i in range(300):
            assert watch.accept((first + i) & 0xFFFF, (10 + pause_ms + i) * MS) is None
    except SequenceRestart as error:
        assert "it has restarted" in str(error) and watch.restarts == 1
    else:
        raise AssertionError("300 records of another count, and not a word")


def test_a_sender_that_counts_anew() -> None:
    watch = SequenceWatch(1 << 32, RATE_HZ)
    for number in range(5000, 5010):
        watch.accept(number, number * MS)
    for number in range(1, RESTART_AFTER):
        assert watch.accept(number, (5010 + number) * MS) is None
    with pytest.raises(SequenceRestart, match="began anew at 1 after 5009"):
        watch.accept(RESTART_AFTER, 5020 * MS)
    assert (watch.restarts, watch.lost) == (1, 0)
    assert watch.accept(70, 5021 * MS) is None and watch.accept(71, 5022 * MS) == 0
    wrapping = SequenceWatch(1 << 32, RATE_HZ)
    assert [wrapping.accept(n, i * MS) for i, n in enumerate((0xFFFFFFFE, 0xFFFFFFFF, 0, 2))] == [
        None,
        0,
        0,
        1,
    ]


def test_a_host_that_was_held_up_loses_records_and_no_more() -> None:
    """The socket kept 300 records, the others of two seconds are lost: no restart."""
    watch = SequenceWatch(1 << 16, RATE_HZ)
    for number in range(100):
        watch.accept(number, number * MS)
    fresh = [watch.accept(number, 2100 * MS) for number in range(100, 400)]
    assert fresh == [0] * 300
    assert watch.accept(2100, 2101 * MS) is None, "more than the second that is kept: taken up after a restart"
    watch = SequenceWatch(1 << 16, RATE_HZ)
    for number in range(100):
        watch.accept(number, number * MS)
    assert [watch.accept(number, 900 * MS) for number in (100, 101, 900)] == [0, 0, 798]
