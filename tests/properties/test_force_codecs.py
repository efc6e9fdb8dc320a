"""Codecs of the force/torque sensors under any cut, any damage and any bytes; numbered records under a bad network."""

from __future__ import annotations

from hypothesis import example, given
from hypothesis import strategies as st

from sioms.sdk.codec import ati_rdt as rdt
from sioms.sdk.codec import ft300, http_get
from sioms.sdk.codec import schunk_ifb as ifb
from sioms.sdk.codec.sequence import RESTART_AFTER, SequenceWatch
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
    commands = ifb.Commands()
    exchanges = [
        rdt.start(rdt.Command.REALTIME, 0.1), commands.get(ifb.PRODUCT), commands.act(ifb.Command.STOP),
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


@given(
    st.integers(0, 0xFFFF), st.lists(st.sampled_from(["good", "good", "good", "lost", "doubled", "late"]), max_size=120)
)  # fmt: skip
def test_a_bad_network_is_counted_exactly(first: int, fates: list[str]) -> None:
    """Each number is sent once; some are lost, doubled, or overtaken by the next that arrives: the counts tell which."""
    watch = SequenceWatch(1 << 16)
    watch.accept(first)
    held: list[int] = []
    fresh = 0
    arrived = ["start"]
    for step, fate in enumerate([*fates, "good"], start=1):
        number = (first + step) & 0xFFFF
        if fate == "lost":
            continue
        if fate == "late":
            if len(held) < RESTART_AFTER - 2:
                held.append(number)
                continue
            fate = "good"
        lost_before = watch.accept(number)
        assert lost_before is not None and lost_before >= 0
        fresh += 1
        arrived.append(fate)
        if fate == "doubled":
            assert watch.accept(number) is None
        for each in held:
            assert watch.accept(each) is None
            arrived.append("late")
        held.clear()
    assert watch.lost == fates.count("lost")
    assert watch.late == arrived.count("late")
    assert watch.doubled == arrived.count("doubled")
    assert watch.restarts == 0


@given(st.lists(st.integers(0, 0xFFFF), max_size=200))
def test_any_numbers_keep_the_counts_sane(numbers: list[int]) -> None:
    watch = SequenceWatch(1 << 16)
    for number in numbers:
        lost = watch.accept(number)
        assert lost is None or 0 <= lost < 1 << 15
    assert watch.lost >= 0 and watch.late >= 0 and watch.doubled >= 0


def test_a_sender_that_counts_anew() -> None:
    watch = SequenceWatch(1 << 32)
    for number in range(5000, 5010):
        watch.accept(number)
    answers = [watch.accept(number) for number in range(1, 20)]
    assert answers == [None] * (RESTART_AFTER - 1) + [0] * (19 - RESTART_AFTER + 1)
    assert (watch.restarts, watch.lost) == (1, 0)
    watch.expect_anew()
    assert watch.accept(70) == 0 and watch.lost == 0
    assert SequenceWatch(1 << 32).accept(7) == 0
    wrapping = SequenceWatch(1 << 32)
    assert [wrapping.accept(n) for n in (0xFFFFFFFE, 0xFFFFFFFF, 0, 2)] == [0, 0, 0, 1]
