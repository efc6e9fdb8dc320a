"""The files under etc/ against the programs that read them: systemd-analyze, sysusers, tmpfiles, udev."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parents[2]
ETC = TREE / "etc"
EXPOSURE_BELOW = 2.0


def needs(program):
    return pytest.mark.skipif(shutil.which(program) is None, reason=f"{program} is not on this machine")


def run(*command):
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "LC_ALL": "C.UTF-8"})


STARTS = {
    "sioms.service": "ExecStart=/opt/sioms/bin/siomsd --config /etc/sioms/workcell.toml\n",
    "sioms-serve.service": "ExecStart=/opt/sioms/bin/sioms serve --listen *:5770 --socket /run/sioms/siomsd.sock\n",
}


@pytest.fixture(params=STARTS)
def unit(tmp_path, request):
    """Each unit with an executable of this machine in the place of the installed program."""
    text = (ETC / request.param).read_text()
    assert text.count(STARTS[request.param]) == 1
    path = tmp_path / request.param
    path.write_text(re.sub("ExecStart=/opt/sioms/bin/[a-z]+", "ExecStart=/bin/true", text))
    return path


def verify(unit):
    return run("systemd-analyze", "verify", "--man=no", unit)


@needs("systemd-analyze")
def test_unit_verifies_silently(unit):
    done = verify(unit)
    assert (done.returncode, done.stderr) == (0, "")


@needs("systemd-analyze")
def test_an_unknown_key_would_be_noticed(unit):
    """verify exits 0 on unknown keys, so only its silence proves anything."""
    unit.write_text(unit.read_text().replace("[Service]", "[Service]\nProtectEverything=yes"))
    assert "ProtectEverything" in verify(unit).stderr


@needs("systemd-analyze")
def test_exposure_is_low(unit):
    done = run("systemd-analyze", "security", "--offline=true", "--no-pager", unit)
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert found, done.stdout + done.stderr
    assert float(found[1]) < EXPOSURE_BELOW, done.stdout


def test_unit_keeps_what_the_daemon_needs():
    keys = re.findall(r"^(\w+)=(.*)$", (ETC / "sioms.service").read_text(), re.MULTILINE)
    settings = dict(keys)
    assert settings["Type"] == "notify"
    assert settings["RuntimeDirectory"] == "sioms"
    assert settings["RestrictRealtime"] == "no"
    assert int(settings["LimitRTPRIO"]) >= 1
    assert settings["LimitMEMLOCK"] == "infinity"
    assert "PrivateUsers" not in settings
    assert "PrivateDevices" not in settings
    assert {"char-ttyUSB rw", "char-gpiochip rw"} <= {value for key, value in keys if key == "DeviceAllow"}
    # whatever ends the service, the drivers hear SIGTERM before they are killed, and have time to stop
    assert (settings["KillMode"], settings["WatchdogSignal"]) == ("control-group", "SIGTERM")


@needs("systemd-sysusers")
@needs("systemd-tmpfiles")
@pytest.mark.root
def test_users_and_folders_are_made(tmp_path):
    """Both programs run for real on an empty root folder."""
    root = tmp_path / "root"
    (root / "etc").mkdir(parents=True)
    done = run("systemd-sysusers", f"--root={root}", ETC / "sysusers.d" / "sioms.conf")
    assert done.returncode == 0, done.stderr
    user, _, uid, gid, *_ = (root / "etc" / "passwd").read_text().split(":")
    groups = dict(re.findall(r"^(\w+):x:\d+:(.*)$", (root / "etc" / "group").read_text(), re.MULTILINE))
    assert user == "sioms"
    assert groups == {"dialout": "sioms", "sioms": ""}
    done = run("systemd-tmpfiles", f"--root={root}", "--create", ETC / "tmpfiles.d" / "sioms.conf")
    assert (done.returncode, done.stderr) == (0, "")
    folder, settings = (root / "run" / "sioms").stat(), (root / "etc" / "sioms").stat()
    assert (folder.st_mode & 0o777, folder.st_uid, folder.st_gid) == (0o750, int(uid), int(gid))
    assert (settings.st_mode & 0o777, settings.st_uid, settings.st_gid) == (0o750, 0, int(gid))
    done = run("systemd-sysusers", f"--root={root}", ETC / "sysusers.d" / "sioms-serve.conf")
    assert done.returncode == 0, done.stderr
    assert re.search(r"^sioms:x:\d+:sioms-serve$", (root / "etc" / "group").read_text(), re.MULTILINE)


def rules():
    """Return the rules of the udev file, continued lines joined."""
    text = (ETC / "udev" / "60-sioms.rules").read_text().replace("\\\n", "")
    return [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]


def test_udev_rules_are_well_formed_and_match_before_they_assign():
    item = re.compile(r'(?P<key>[A-Z]+(?:\{[^}]+\})?)(?P<op>==|!=|\+=|:=|=)"(?P<value>[^"]*)"')
    matched = {"SUBSYSTEM", "KERNEL", "ACTION", "DRIVERS", "ATTRS"}
    assigned = {"OWNER", "GROUP", "MODE", "SYMLINK", "ENV", "ATTR"}
    for rule in rules():
        parts = [item.fullmatch(part.strip()) for part in rule.split(",")]
        assert all(parts), rule
        kinds = [(part["key"].partition("{")[0], part["op"]) for part in parts]
        assert all(key in matched if op in ("==", "!=") else key in assigned for key, op in kinds), rule
        assert kinds[0][1] == "==" and kinds[-1][1] != "==", rule


@needs("udevadm")
def test_udev_agrees():
    if run("udevadm", "verify", "--help").returncode:
        pytest.skip("this udevadm has no verify (it came with systemd 254)")
    done = run("udevadm", "verify", "--resolve-names=never", ETC / "udev" / "60-sioms.rules")
    assert done.returncode == 0, done.stdout + done.stderr
