"""Grbl's lines: reports with fields in any order, answers among other lines, and what is damaged."""

import pytest
from frames_rig import feed

from sioms.drivers.grbl import codec as grbl
from sioms.drivers.grbl import simulator
from sioms.sdk.exchange import DeviceError, LinkError, StateLost


@pytest.mark.parametrize("step", [1, 3, 1000])
def test_answers(step: int) -> None:
    build = b"[VER:1.1h.20190830:]\r\n[OPT:V,15,128]\r\nok\r\n"
    answer = feed(grbl.command("$I", 0.5), build + b"<Idle|MPos:0,0,0>\r\n", step)
    assert isinstance(answer, grbl.Answer)
    assert (answer.tagged("VER"), answer.tagged("OPT"), answer.tagged("GC")) == (
        "1.1h.20190830:",
        "V,15,128",
        "",
    )
    found = feed(grbl.command("$$", 0.5), b"$0=10\r\n$110=500.000\r\n$120=10.5 (mm/s^2)\r\nok\r\n", step)
    assert isinstance(found, grbl.Answer)
    assert found.settings() == {0: 10.0, 110: 500.0, 120: 10.5}
    with pytest.raises(DeviceError, match="error:15, jog target outside") as caught:
        feed(grbl.command("$J=G91X1F1", 0.5), b"error:15\r\n", step)
    assert caught.value.errno == 22
    with pytest.raises(DeviceError, match="error:79, unknown"):
        feed(grbl.command("$H", 0.5), b"[MSG:x]\r\nerror:79\r\n", step)
    with pytest.raises(StateLost, match="started anew meanwhile"):
        feed(grbl.command("$X", 0.5), b"\r\nGrbl 1.1h ['$' for help]\r\nok\r\n", step)
    with pytest.raises(StateLost, match="started anew meanwhile"):  # a "?" is lost on a controller that starts
        feed(grbl.status(0.5), b"\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n", step)
    with pytest.raises(LinkError, match="incomplete"):  # "ok" inside a line is none
        feed(grbl.command("$X", 0.5), b"[MSG:not ok]\r\n[echo:ok]\r\n", step)
    banner = b"ALARM:3\r\n\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n"
    lines = feed(grbl.reset(2.0), banner + b"[MSG:'$H'|'$X' to unlock]\r\n", step)
    assert isinstance(lines, tuple) and grbl.alarm_of(lines) == 3


@pytest.mark.parametrize(
    ("line", "report"),
    [
        (
            "<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>",
            grbl.Report("Idle", -1, (0.0, 0.0, 0.0), None, (0.0, 0.0, 0.0)),
        ),
        (
            "<Hold:1|FS:500,8000|WPos:1.5,-2.000,3.25,90.000|Pn:XPD|Bf:12,100|H:0,0|T:2>",
            grbl.Report("Hold", 1, None, (1.5, -2.0, 3.25, 90.0), None, 12, "XPD"),
        ),
        ("<Alarm:14|MPos:1,2,3|FW:grblHAL>", grbl.Report("Alarm", 14, (1.0, 2.0, 3.0))),
    ],
)
def test_reports(line: str, report: grbl.Report) -> None:
    assert grbl.parse_report(line) == report
    data = b"ok\r\nALARM:1\r\n" + line.encode() + b"\r\n"
    for step in (1, 7, 1000):
        value = feed(grbl.status(0.2), data + b"ok\r\n", step)
        assert value == (report, ("ok", "ALARM:1"))


@pytest.mark.parametrize("line", ["<Idle", "<>", "Idle|MPos:1>", "<Jog|MPos:1.2.3,4>", "<Run|MPos:nope>", "<Run|Bf:x>"])
def test_damaged_reports(line: str) -> None:
    with pytest.raises(LinkError, match="read the status"):
        grbl.parse_report(line)


def test_an_endless_reply_is_an_error() -> None:
    with pytest.raises(LinkError, match="without an answer"):
        feed(grbl.status(0.2), b"\xff" * 40000, 512)


def test_lines_that_cannot_be_sent() -> None:
    assert grbl.command("", 0.1).data == b"\n"
    for line in ("G1X" + "0" * 80, "a\nb"):
        with pytest.raises(ValueError, match="want "):
            grbl.command(line, 0.1)
    assert not grbl.command("$J=X1F1", 0.1).repeatable
    assert grbl.jog({"X": -0.00001, "Z": 1.23456}, 0.0) == "$J=G53G90G21X0Z1.2346F0.001"
    longest = grbl.jog(dict.fromkeys(grbl.LETTERS[:6], -1234.5678), 123456.789)
    assert len(longest) < grbl.LINE_LIMIT
    assert "; the position is lost" in grbl.alarm_text(1) and "lost" not in grbl.alarm_text(2)
    assert "lost" in grbl.alarm_text(99)


def test_the_simulated_controller_answers_as_the_documents_say() -> None:
    now = 1.0
    device = simulator.Controller(homing=False, clock=lambda: now)

    def say(data: bytes) -> str:
        return b"".join(device.take(data)).decode()

    assert say(b"\r\n") == "ok\r\nok\r\n"  # CR LF is two lines
    assert "[VER:1.1h" in say(b"$I\n")
    for line, error in (
        ("$J=X1", 22),
        ("$J=G91F100", 26),
        ("$J=G2X1F1", 16),
        ("$q", 3),
        ("$0=-1", 4),
        ("9X", 1),
    ):
        assert say(f"{line}\n".encode()) == f"error:{error}\r\n", line
    assert say(b"$J=G91X10F6000\n") == "ok\r\n"
    assert say(b"?").startswith("<Jog|MPos:0.000")
    assert say(b"G0X1\n") == "error:9\r\n"  # locked while it jogs
    now = 1.05
    device.due()
    assert 0 < device.planner.position[0] < 10
    assert say(b"\x18") == "ALARM:3\r\n" and say(b"?") == "", "half a second behind an alarm it is deaf"
    now = 1.6
    assert "Grbl 1.1h" in b"".join(device.due()).decode()
    assert say(b"$J=G91X1F100\n") == "error:8\r\n" and say(b"G0X1\n") == "error:9\r\n"
    assert device.planner.slip[0] > 0
