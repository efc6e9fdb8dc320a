"""ODrive's lines: the documented checksums, replies among refusals, and what is damaged."""

import math

import pytest
from frames_rig import feed

from sioms.drivers.odrive import codec as odrive
from sioms.drivers.odrive import simulator
from sioms.sdk.exchange import DeviceError, LinkError


def reply(*texts: str) -> bytes:
    return b"".join(odrive.line(text).replace(b"\n", b"\r\n") for text in texts)


@pytest.mark.parametrize(("text", "xor"), [("v 0 1 0", 103), ("f 0", 118), ("c 0 0.1", 124), ("p 0 -2 0 0", 95)])
def test_documented_checksums(text: str, xor: int) -> None:
    assert odrive.line(text) == f"{text}*{xor}\n".encode()


def test_the_documented_reply() -> None:
    assert odrive.line("r vbus_voltage ").endswith(b"*93\n") and odrive.line("r vbus_voltage").endswith(b"*125\n")
    data = b"24.087744*32\r\n" + reply("0.0 0.0")
    for step in (1, 4, 100):
        assert feed(odrive.read(["vbus_voltage"], 0.1), data + b"1*49\r\n", step) == [[24.087744]]
    board = simulator.Board()
    assert board.take(b"r vbus_voltage *93\n") == [b"24.087744*32\r\n"]
    assert board.take(b"r vbus_voltage*125\r") == [b"24.087744*32\r\n"]
    assert board.take(b"r vbus_voltage *94\n") == []
    assert board.take(b"r vbus_voltage ; what\n") == [b"24.087744\r\n"]
    assert board.take(b"v 0 1 0*103\nf 7!nonsense\n") == [b"invalid motor 7\r\n", b"unknown command\r\n"]
    # an empty line is an unknown command, so CR LF draws one; one that is too long takes the next with it
    assert board.take(b"f 9\r\n") == [b"invalid motor 9\r\n", b"unknown command\r\n"]
    assert board.take(b"x" * 256 + b"f 9\nf 8\n") == [b"invalid motor 8\r\n"]
    assert board.take(b"f 1") == [] and board.take(b"1\n") == [b"invalid motor 11\r\n"]  # no time-out
    # a line without a checksum is obeyed, and read as far as numbers go
    assert board.take(b"v 0 2.5x*\n") == [] and board.axes[0].p["controller.input_vel"] == 2.5
    assert board.take(b"w axis0.current_state 8\nw vbus_voltage 1\nw axis0.requested_state x\n") == 3 * [
        b"not implemented\r\n"
    ]
    assert board.take(b"r axis0.no\n") == [b"invalid property\r\n"]


@pytest.mark.parametrize("step", [1, 5, 1000])
def test_sets_and_what_is_read_behind_them(step: int) -> None:
    back = [("axis0.controller.input_pos", 1.25)]
    move = odrive.confirmed(["t 0 1.25"], back, 0.1)
    assert move.data == odrive.line("t 0 1.25") + odrive.line("r axis0.controller.input_pos") + odrive.line("f 0")
    assert not move.repeatable and odrive.read(["x"], 0.1).repeatable
    assert feed(move, reply("1.25", "0 0"), step) == [[1.25]]
    with pytest.raises(LinkError, match="reads 0 afterwards"):
        feed(move, reply("0", "0 0"), step)
    # a refused set speaks before the reply, and both are taken
    with pytest.raises(DeviceError, match="invalid motor 0"):
        feed(move, reply("invalid motor 0", "1.25", "0 0"), step)
    with pytest.raises(DeviceError, match="invalid property"):
        feed(odrive.read(["axis0.x"], 0.1), reply("invalid property", "0 0"), step)
    # what a board says to stray bytes carries no checksum, and is not for us
    stray = b"unknown command\r\n"
    assert feed(move, stray + reply("1.25") + stray + reply("0 0"), step) == [[1.25]]
    for bad in (b"1.25*1\r\n", b"\xff*3\r\n"):
        with pytest.raises(LinkError, match="checksum"):
            feed(move, bad + reply("0 0"), step)
    limit = odrive.read(["axis0.motor.config.torque_lim", "x"], 0.1)
    assert feed(limit, reply("inf", "1", "0 0"), step) == [[math.inf], [1.0]]
    for text in ("nan", "-inf"):
        with pytest.raises(LinkError, match="not a number"):
            feed(limit, reply(text, "1", "0 0"), step)
    for text in ("nan", "word", "inf"):
        with pytest.raises(LinkError, match="not a number"):
            feed(move, reply(text, "0 0"), step)
    with pytest.raises(LinkError, match="incomplete"):
        feed(odrive.read(["a", "b"], 0.1), reply("1", "0 0"), step)
    with pytest.raises(LinkError, match="1, 1, 1"):  # one reply too many shifts the others
        feed(odrive.read(["a", "b"], 0.1), reply("1", "1", "2", "0 0"), step)
    with pytest.raises(LinkError, match="without an end"):
        feed(move, b"x" * 2000, step)


def test_lines_that_cannot_be_sent() -> None:
    for text in ("r " + "x" * 300, "f 0!", "f 0\nf 1", "f 0*3", "f 0;"):
        with pytest.raises(ValueError, match="want "):
            odrive.line(text)


def test_errors_in_words() -> None:
    assert odrive.error_text(1, 0, []) == ""
    text = odrive.error_text(1, 0x840, [("motor.error", 0x10), ("encoder.error", 0)])
    assert text == "axis1.error 0x840, motor failed, watchdog expired; motor.error 0x10"
