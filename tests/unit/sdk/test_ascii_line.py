"""Lines that are dropped, each counted under its reason."""

from sioms.drivers.ascii_stream.codec import LineReceiver


def test_each_fault_has_its_counter() -> None:
    receiver = LineReceiver(2)
    rows = receiver.feed(
        b"1,2\n"  # cut by opening
        b"1 , 2\r\n\n# 3,4\n"
        b"1,2,3\n"
        b"1,x\n1,nan\n1,inf\n"
        b"1,2*2F\n1,2*00\n1,2*1\n" + b"9" * 5000 + b"\n3;4\n"
    )
    assert rows == [(1.0, 2.0), (1.0, 2.0), (3.0, 4.0)]
    counters = receiver.counters
    assert (counters.lines, counters.bad_columns, counters.bad_number) == (3, 1, 3)
    assert (counters.bad_checksum, counters.oversized) == (2, 1)


def test_a_demanded_checksum_must_be_there() -> None:
    receiver = LineReceiver(2, checked=True)
    assert receiver.feed(b"\n1,2\n1,2*2f\n") == [(1.0, 2.0)]
    assert receiver.counters.bad_checksum == 1
