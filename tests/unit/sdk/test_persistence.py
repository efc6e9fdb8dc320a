"""Positions over a restart: files, what of them is believed, and that no interruption leaves a wrong entry."""

import errno
import math
import os
import resource

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_rig import MODE, Rig, axis, records

from sioms.motion import AxisKind, Homing, Restore
from sioms.protocol.flags import AxisStatus as S
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AxisBlock, BlockSpec
from sioms.sdk.persistence import (
    AT_REST,
    HOMED,
    Contents,
    Entry,
    PositionFile,
    decode,
    encode,
    keep_positions,
    offset_of,
)

BOOT = "b007"
ALWAYS, MATCHING = Restore("always"), Restore("matching", 1e-3)


@pytest.fixture(autouse=True, scope="module")
def quick_disk():
    """Do not wait for the disk: what is written is in the kernel."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


FILES = []
"""Files of the processes of a test."""


@pytest.fixture(autouse=True)
def ended():
    """After a test nothing is open of processes that were killed in it."""
    yield
    while FILES:
        FILES.pop().let_go()


class Kept:
    """A bank with a file, that can be killed and started again."""

    def __init__(self, path, given, start=0.0, boot=BOOT):
        self.said = []
        self.file = PositionFile(str(path), [given], boot, lambda level, text: self.said.append(f"{level} {text}"))
        FILES.append(self.file)
        self.rig = Rig([given], start=[start], keeper=self.file)


def moved_to(path, position, rule, *, offset=0.25, homed=True, close=False, ticks=None):
    """Calibrate an axis, home it, move it, and let its process end."""
    cell = Kept(path, axis(restore=rule))
    cell.rig.bank.calibrate([0], [offset])
    cell.rig.bank.set_homed([0], homed)
    cell.rig.tick(102)
    assert decode(path.read_bytes()).entries["x"].state & AT_REST
    cell.rig.write(mode=MODE.POSITION, position=position)
    if ticks is None:
        cell.rig.run()
        cell.rig.tick(102)
    else:
        cell.rig.tick(ticks)
    if close:
        cell.file.close()
    return cell


@pytest.mark.parametrize(("rule", "reads"), [(ALWAYS, 0.0), (ALWAYS, 7.0), (MATCHING, 0.5), (MATCHING, 0.5009)])
@pytest.mark.parametrize("homed", [True, False])
def test_a_position_at_rest_comes_back_and_homed_as_it_was(tmp_path, rule, reads, homed):
    moved_to(tmp_path / "x", 0.75, rule, homed=homed)  # the device reads 0.5
    after = Kept(tmp_path / "x", axis(restore=rule), start=reads)
    wanted = 0.75 if rule is ALWAYS else reads + 0.25
    assert after.rig.field("position") == pytest.approx(wanted) == after.rig.field("commanded_position")
    assert bool(after.rig.field("status") & S.HOMED) == homed
    assert "restored" in after.said[-1]
    after.rig.write(mode=MODE.POSITION, position=1.0)
    after.rig.run()
    assert after.rig.field("position") == pytest.approx(1.0)


@pytest.mark.parametrize("reads", [0.502, 0.0, -0.5, math.nan])
def test_what_reads_otherwise_has_moved_and_is_not_restored(tmp_path, reads):
    moved_to(tmp_path / "x", 0.75, MATCHING)
    after = Kept(tmp_path / "x", axis(restore=MATCHING), start=reads)
    assert not after.rig.field("status") & S.HOMED
    assert "not restored, not homed" in after.said[-1]
    if math.isfinite(reads):
        assert after.rig.field("position") == reads and "reads" in after.said[-1]


@pytest.mark.parametrize("rule", [ALWAYS, MATCHING])
@pytest.mark.parametrize("ticks", [1, 2, 100, 400])
def test_what_was_in_motion_is_not_restored(tmp_path, rule, ticks):
    before = moved_to(tmp_path / "x", 0.75, rule, ticks=ticks)
    after = Kept(tmp_path / "x", axis(restore=rule), start=before.rig.raw[0])
    assert not after.rig.field("status") & S.HOMED
    assert "not known to be at rest" in after.said[-1]


def test_a_servo_that_still_settles_is_not_at_rest(tmp_path):
    """The set-point has arrived, the axis swings on: a kill now would leave it anywhere near."""
    swing = {"t": 0.0}

    def plant(_output, dt):
        swing["t"] += dt
        return np.array([0.01 * math.exp(-swing["t"] / 0.05) * math.cos(60 * swing["t"])])

    file = PositionFile(str(tmp_path / "x"), [axis(restore=ALWAYS)], BOOT, lambda *_: None)
    FILES.append(file)
    rig = Rig([axis(restore=ALWAYS)], keeper=file, plant=plant)
    marked = []
    for _ in range(700):
        rig.tick()
        marked.append(decode((tmp_path / "x").read_bytes()).entries["x"].state & AT_REST)
    first = marked.index(AT_REST)
    assert rig.bank.is_idle([0]) and 0.3 < first * 1e-3 < 0.6 and all(marked[first:])
    swing["t"] = 0.0  # pushed
    rig.tick(2)
    assert not decode((tmp_path / "x").read_bytes()).entries["x"].state & AT_REST


def test_without_the_first_reading_nothing_is_forgotten(tmp_path):
    moved_to(tmp_path / "x", 0.75, ALWAYS)
    for _ in range(3):  # started and killed before the device has answered
        PositionFile(str(tmp_path / "x"), [axis(restore=ALWAYS)], BOOT, lambda *_: None)
    assert Kept(tmp_path / "x", axis(restore=ALWAYS)).rig.field("position") == pytest.approx(0.75)


def test_a_process_on_its_way_out_cannot_write_into_its_successor(tmp_path):
    before = moved_to(tmp_path / "x", 0.75, ALWAYS)
    after = Kept(tmp_path / "x", axis(restore=ALWAYS))
    before.rig.write(mode=MODE.POSITION, position=2.0)
    before.rig.run()
    after.rig.tick(102)
    before.file.close()
    held = decode((tmp_path / "x").read_bytes())
    assert held.entries["x"].position == pytest.approx(0.75) == after.rig.field("position") and not held.closed


def test_after_another_boot_only_an_orderly_end_is_believed(tmp_path):
    moved_to(tmp_path / "x", 0.75, ALWAYS)
    fallen = Kept(tmp_path / "x", axis(restore=ALWAYS), boot="other")
    assert fallen.rig.field("position") == 0.0 and "orderly end" in fallen.said[-1]
    moved_to(tmp_path / "x", 0.75, ALWAYS, close=True)
    assert Kept(tmp_path / "x", axis(restore=ALWAYS), boot="other").rig.field("position") == pytest.approx(0.75)
    moved_to(tmp_path / "x", 0.75, ALWAYS)
    unknown = Kept(tmp_path / "x", axis(restore=ALWAYS), boot="")
    assert unknown.rig.field("position") == 0.0, "a system that does not tell its boot"


def test_an_axis_without_a_rule_keeps_to_its_device_and_others_are_found_by_name(tmp_path):
    settings = [axis(name="a", restore=ALWAYS), axis(name="b"), axis(name="c", restore=ALWAYS)]
    rig = Rig(settings, keeper=PositionFile(str(tmp_path / "x"), settings, BOOT, lambda *_: None))
    rig.bank.calibrate([0, 1, 2], [1.0, 2.0, 3.0 - 1e-3])
    rig.tick(102)
    settings = settings[::-1]
    rig = Rig(settings, keeper=PositionFile(str(tmp_path / "x"), settings, BOOT, lambda *_: None))
    assert rig.bank.rows["position"].tolist() == [pytest.approx(3.0 - 1e-3), 0.0, 1.0]


@pytest.mark.parametrize(
    "data", [b"", b"SIOMSPOS", b"x" * 200, encode(Contents({"x": Entry(3, 1.0, 1.0)}, True, BOOT))[:-1]]
)
def test_a_file_that_is_none_is_told_and_replaced(tmp_path, data):
    (tmp_path / "x").write_bytes(data)
    cell = Kept(tmp_path / "x", axis(restore=ALWAYS))
    assert cell.rig.field("position") == 0.0 and any("not restored" in said for said in cell.said)
    cell.rig.tick(102)
    assert decode((tmp_path / "x").read_bytes()).entries["x"].state == AT_REST


def test_a_stepper_stays_where_it_is_when_its_position_is_restored(tmp_path):
    given = axis(kind=AxisKind.STEPPER, k=None, restore=ALWAYS)
    (tmp_path / "x").write_bytes(encode(Contents({"x": Entry(AT_REST, 9.0, 1.5)}, True, BOOT)))
    cell = Kept(tmp_path / "x", given, start=0.2)
    assert cell.rig.field("position") == pytest.approx(1.5)
    assert cell.rig.bank.tick(cell.rig.now_ns + 10**6, cell.rig.raw)[0] == pytest.approx(0.2)


def test_what_must_be_homed_may_move_when_it_was_restored_homed(tmp_path):
    given = axis(restore=ALWAYS, homing=Homing(0.5, 0.05, required=True))
    (tmp_path / "x").write_bytes(encode(Contents({"x": Entry(AT_REST | HOMED, 9.0, 1.5)}, True, BOOT)))
    Kept(tmp_path / "x", given).rig.write(mode=MODE.POSITION, position=1.0)


entries = st.dictionaries(
    st.text("abcdefgh_0123456789-", min_size=1, max_size=20),
    st.builds(Entry, st.integers(0, 3), st.floats(allow_nan=False), st.floats(allow_nan=False)), max_size=8,
)  # fmt: skip


@given(entries, st.booleans(), st.sampled_from(["", BOOT, "f" * 32]))
def test_a_file_is_read_as_it_was_written(found, closed, boot):
    assert decode(encode(Contents(found, closed, boot))) == Contents(found, closed, boot)


@given(st.binary(max_size=300), st.integers(0, 200))
def test_no_bytes_do_more_than_be_refused(tail, keep):
    try:
        decode(encode(Contents({"x": Entry(3, 1.0, 2.0)}, True, BOOT))[:keep] + tail)
    except ValueError as error:
        assert str(error)


class Killed(Exception):
    """The process ends here."""


class Dying(PositionFile):
    """A file whose process is killed within one of its writes, when ``left`` is used up: the beginning is written."""

    left, cut = 1 << 30, 0

    def _put(self, first, end):
        if not self.left:
            super()._put(first, min(end, first + self.cut))
            raise Killed
        self.left -= 1
        super()._put(first, end)


@settings(max_examples=100)
@given(st.lists(st.tuples(st.booleans(), st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=8), st.data())
def test_wherever_a_process_is_killed_no_entry_is_wrong(tmp_path_factory, history, data):
    """What is marked at rest is, whole, the place noted last or, before that note is done, the one before it."""
    path = tmp_path_factory.mktemp("kept") / "x"
    file = Dying(str(path), [axis(restore=ALWAYS)], BOOT, lambda *_: None)
    file.left, file.cut = data.draw(st.integers(0, 4 * len(history))), data.draw(st.integers(0, 1)) * 8
    noted = [(False, 0.0, 0.0)]
    complete = False
    try:
        for i, (at_rest, raw, position) in enumerate(history):
            file._still_at[0] = raw  # has stood there for long
            noted.append((at_rest, raw, position))
            complete = False
            file.note(*(np.array([v]) for v in (at_rest, at_rest, raw, position)), now_ns=(i + 1) * 10**9)
            complete = True
    except Killed:
        assert not complete
    file.let_go()
    entry = decode(path.read_bytes()).entries["x"]
    if complete:
        assert bool(entry.state & AT_REST) == noted[-1][0]
    believable = [note[1:] for note in (noted[-1:] if complete else noted[-2:]) if note[0]]
    assert not entry.state & AT_REST or entry[1:] in believable


def test_only_banks_that_ask_for_it_get_a_file_and_a_missing_folder_is_told(tmp_path):
    said = []
    block = AxisBlock(BlockSpec("", NodeClass.AXIS, (ChannelInfo("x", "m"),)), Rig([axis(restore=ALWAYS)]).bank)
    plain = AxisBlock(BlockSpec("plain", NodeClass.AXIS, (ChannelInfo("x", "m"),)), Rig([axis()]).bank)
    log = lambda level, text: said.append(text)  # noqa: E731
    assert keep_positions("", "mod0", [block, plain], log) == [] and "give [workcell] a state_folder" in said[0]
    (tmp_path / "file").write_text("")
    assert keep_positions(str(tmp_path / "file"), "mod0", [block], log) == [] and "not kept" in said[1]
    assert block.bank.keeper is None
    kept = keep_positions(str(tmp_path / "new" / "folder"), "mod0", [block, plain], log)
    assert kept == [block.bank.keeper] and plain.bank.keeper is None and len(said) == 2
    assert [p.name for p in (tmp_path / "new" / "folder").iterdir()] == ["mod0.positions"]


def test_where_the_disk_is_full_no_place_of_an_earlier_run_is_left_to_be_believed(tmp_path):
    block = AxisBlock(BlockSpec("", NodeClass.AXIS, (ChannelInfo("x", "m"),)), Rig([axis(restore=ALWAYS)]).bank)
    (file,) = keep_positions(str(tmp_path), "mod0", [block], lambda *_: None)
    file.close()
    block.bank.keeper = None
    said = []
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, hard))
    try:
        kept = keep_positions(str(tmp_path), "mod0", [block], lambda level, text: said.append((level, text)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert kept == [] and block.bank.keeper is None
    assert [level for level, _ in said] == ["error"] and "positions are not kept" in said[0][1]
    assert list(tmp_path.iterdir()) == []


def failing(error):
    """Return what stands in for a function of os whose disk is broken."""

    def fail(*_):
        raise OSError(error, os.strerror(error))

    return fail


@pytest.mark.parametrize("fault", ["EIO", "ENOSPC", "EDQUOT", "short"])
@pytest.mark.parametrize("successor", [False, True])
def test_a_mark_that_cannot_be_taken_away_is_not_believed_and_the_axis_moves(tmp_path, monkeypatch, fault, successor):
    cell = moved_to(tmp_path / "x", 0.75, ALWAYS)
    if successor:
        Kept(tmp_path / "x", axis(restore=ALWAYS)).rig.tick(102)
    broken = failing(getattr(errno, fault, 0)) if fault != "short" else lambda *_: 0
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", broken)
        cell.rig.write(mode=MODE.POSITION, position=2.0)
        cell.rig.run()
    assert cell.rig.field("position") == pytest.approx(2.0)
    told = [said for said in cell.said if "not kept" in said]
    assert len(told) == 1 and str(tmp_path / "x") in told[0]
    cell.file.close()
    assert (tmp_path / "x").exists() == successor
    after = Kept(tmp_path / "x", axis(restore=ALWAYS))
    assert after.rig.field("position") == pytest.approx(0.75 if successor else 0.0)


def test_where_the_file_cannot_be_removed_either_it_says_nothing_that_could_be_believed(tmp_path, monkeypatch):
    cell = moved_to(tmp_path / "x", 0.75, ALWAYS)
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", failing(errno.EIO))
        patch.setattr(os, "unlink", failing(errno.EROFS))
        cell.rig.write(mode=MODE.POSITION, position=2.0)
        cell.rig.run()
    assert any("remove it before the next start" in said for said in cell.said)
    assert Kept(tmp_path / "x", axis(restore=ALWAYS)).rig.field("position") == 0.0


def test_an_end_that_does_not_reach_the_disk_is_no_orderly_one(tmp_path, monkeypatch):
    cell = moved_to(tmp_path / "x", 0.75, ALWAYS)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", failing(errno.EIO))
        cell.file.close()
    assert "not kept" in cell.said[-1]
    assert Kept(tmp_path / "x", axis(restore=ALWAYS), boot="other").rig.field("position") == 0.0


def test_a_file_that_somebody_truncates_ends_no_driver_and_is_not_believed(tmp_path):
    """Mapped into memory, the next store would be SIGBUS."""
    cell = moved_to(tmp_path / "x", 0.75, ALWAYS)
    os.truncate(tmp_path / "x", 0)
    cell.rig.write(mode=MODE.POSITION, position=2.0)
    cell.rig.run()
    cell.rig.tick(102)
    cell.file.close()
    assert cell.rig.field("position") == pytest.approx(2.0)
    after = Kept(tmp_path / "x", axis(restore=ALWAYS))
    assert after.rig.field("position") == 0.0 and any("not a position file" in said for said in after.said)


@pytest.mark.parametrize("left", ["file", "link", "pipe"])
def test_what_a_killed_process_left_beside_the_file_is_not_written_to(tmp_path, left):
    other, fresh = tmp_path / "other", tmp_path / "x.new"
    other.write_text("mine")
    {"file": fresh.touch, "link": lambda: fresh.symlink_to(other), "pipe": lambda: os.mkfifo(fresh)}[left]()
    moved_to(tmp_path / "x", 0.75, ALWAYS)
    assert other.read_text() == "mine" and not fresh.exists()
    assert Kept(tmp_path / "x", axis(restore=ALWAYS)).rig.field("position") == pytest.approx(0.75)


def test_what_somebody_puts_beside_the_file_meanwhile_is_not_written_to(tmp_path, monkeypatch):
    """Between looking what a killed process has left and making the file."""
    other, fresh, unlink = tmp_path / "other", tmp_path / "x.new", os.unlink
    other.write_text("mine")

    def unlink_and_put(path):
        try:
            unlink(path)
        finally:
            if str(path) == str(fresh) and not fresh.is_symlink():
                fresh.symlink_to(other)

    monkeypatch.setattr(os, "unlink", unlink_and_put)
    with pytest.raises(FileExistsError):
        Kept(tmp_path / "x", axis(restore=ALWAYS))
    assert other.read_text() == "mine"


def test_offsets_are_those_of_the_rule():
    entry = Entry(AT_REST, 0.5, 0.75)
    assert offset_of(entry, axis(restore=ALWAYS), 0.1) == (0.65, "")
    assert offset_of(entry, axis(restore=MATCHING), 0.5005) == (0.25, "")
    assert offset_of(entry, axis(), 0.5)[0] is None
    assert offset_of(entry._replace(state=HOMED), axis(restore=ALWAYS), 0.5)[0] is None


def test_persistence_has_no_say_in_the_motion(tmp_path):
    """The same commands give the same set-points with a file and without."""
    plain, kept = Rig([axis()]), Kept(tmp_path / "x", axis(restore=ALWAYS)).rig
    for rig in (plain, kept):
        rig.bank.append(records(mode=MODE.POSITION, position=0.3), [0], rig.now_ns)
        rig.run()
    assert np.array_equal(plain.trace("commanded_position"), kept.trace("commanded_position"))


@pytest.mark.parametrize("what", ["folder", "pipe", "unreadable"])
def test_what_is_no_file_holds_up_no_driver(tmp_path, what):
    path = tmp_path / "mod0.positions"
    match what:
        case "folder":
            path.mkdir()
        case "pipe":
            os.mkfifo(path)
        case "unreadable":
            path.symlink_to(path)
    block = AxisBlock(BlockSpec("", NodeClass.AXIS, (ChannelInfo("x", "m"),)), Rig([axis(restore=ALWAYS)]).bank)
    said = []
    keep_positions(str(tmp_path), "mod0", [block], lambda level, text: said.append(text))
    assert said and "positions are not" in said[0]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_place_that_is_no_number_is_not_restored(bad):
    rule = axis(restore=ALWAYS)
    for entry in (Entry(AT_REST, bad, 0.1), Entry(AT_REST, 0.1, bad)):
        offset, why = offset_of(entry, rule, 0.1)
        assert offset is None and why


def test_a_device_that_ends_alone_leaves_no_descriptor_and_no_orderly_end(tmp_path):
    """Its process may go on with other devices."""
    cell = moved_to(tmp_path / "x", 0.75, ALWAYS)
    before = len(os.listdir("/proc/self/fd"))
    cell.file.let_go()
    assert len(os.listdir("/proc/self/fd")) == before - 1
    cell.rig.write(mode=MODE.POSITION, position=2.0)
    cell.rig.run()
    cell.file.close()
    held = decode((tmp_path / "x").read_bytes())
    assert not held.closed and held.entries["x"].position == pytest.approx(0.75)
