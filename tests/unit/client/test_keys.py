"""Folders of keys: who may come in, what is refused, and with which sentence."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from daemon_rig import raises

from sioms.client.keys import Folder
from sioms.client.places import place_of
from sioms.tools.front import main

A, B = "a" * 40, "b" * 40


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(str(tmp_path / "keys"))


def test_a_key_is_made_once_and_is_nobody_elses_to_read(folder: Folder) -> None:
    assert folder.own() is None
    pair = folder.new("kate")
    assert folder.own() == pair and len(pair.secret) == 40 and pair.secret not in repr(folder.allowed())
    assert os.stat(folder.path).st_mode & 0o777 == 0o700 and os.stat(folder.file("secret")).st_mode & 0o777 == 0o600
    with raises(errno.EEXIST, "there is one"):
        folder.new("kate")
    os.chmod(folder.file("secret"), 0o640)
    with raises(errno.EPERM, "others may use it", "chmod 0600"):
        folder.own()
    os.chmod(folder.path, 0o755)
    with raises(errno.EPERM, "chmod 0700"):
        Folder(folder.path)


def test_allow_list_and_revoke(folder: Folder) -> None:
    folder.allow("kate", A, ("ops", "lab"))
    folder.allow("ben", B)
    folder.allow("kate", A, ("lab",))
    assert [(one.name, one.public, one.groups) for one in folder.allowed()] == [("ben", B, ()), ("kate", A, ("lab",))]
    with raises(errno.EEXIST, "sioms key revoke ben"):
        folder.allow("kate", B)
    with raises(errno.EEXIST, "sioms key revoke kate"):
        folder.allow("eva", A)
    folder.revoke("kate")
    with raises(errno.ENOENT, "revoke kate", "there are: ben"):
        folder.revoke("kate")
    for name in ("", "a b", "../x", "x" * 65, "kate\n"):
        with raises(errno.EINVAL, "letters"):
            folder.allow(name, A)
    for key in ("", "short", A + "a", "a" * 39 + "~"):
        with raises(errno.EINVAL, "no public key"):
            folder.allow("eva", key)


def test_an_address_has_one_key(folder: Folder) -> None:
    folder.trust("lab2:5770", A)
    folder.trust("lab2:5770", A)
    with raises(errno.EEXIST, "lab2:5770", A, "sioms key revoke lab2:5770"):
        folder.trust("lab2:5770", B)
    assert folder.distrust("lab2:5770") and not folder.distrust("lab2:5770")


@pytest.mark.parametrize(
    ("name", "text"),
    [("allowed", "kate"), ("allowed", f"kate {A} ops x"), ("allowed", "kate tooshort"), ("allowed", f"a/b {A}"),
     ("trusted", A), ("secret", f"kate {A}"), ("secret", f"kate {A} {B}\nben {A} {B}")],
)  # fmt: skip
def test_a_damaged_file_is_told(folder: Folder, name: str, text: str) -> None:
    folder.new("kate")
    Path(folder.file(name)).write_text(f"# a comment\n\n{text}\n")
    with raises(errno.EINVAL):
        {"allowed": folder.allowed, "trusted": folder.trusted, "secret": folder.own}[name]()


@pytest.mark.parametrize("address", ["zmq://", "zmq://x", "zmq://:5", "zmq://x:0", "zmq://x:65535", "zmq://x:y", "x:5"])
def test_an_address_that_is_none(address: str) -> None:
    with raises(errno.EINVAL, "want zmq://HOST:PORT"):
        place_of(address)


def test_addresses() -> None:
    assert place_of("zmq://lab2:5770") == ("zmq", "lab2", 5770) and place_of("zmq://[::1]:5770") == ("zmq", "::1", 5770)
    assert place_of("zenoh://lab2:5780") == ("zenoh", "lab2", 5780)


def test_the_commands(folder: Folder, capsys: pytest.CaptureFixture[str]) -> None:
    def sioms(*words: str) -> tuple[int, str, str]:
        status = main([*words, "--keys", folder.path])
        said = capsys.readouterr()
        return status, said.out, said.err

    status, out, _ = sioms("key", "new", "kate")
    assert status == 0 and len(out.split()[-1]) == 40
    assert sioms("key", "allow", "ben", A, "--group", "ops", "--group", "lab")[0] == 0
    assert sioms("key", "trust", "zmq://lab2:5770", B)[0] == 0
    status, out, _ = sioms("key", "list")
    assert [line.split()[0] for line in out.splitlines()] == ["own", "allowed", "trusted"] and "ops,lab" in out
    secret = folder.own()
    assert secret is not None and secret.secret not in out
    assert sioms("key", "revoke", "zmq://lab2:5770")[0] == sioms("key", "revoke", "ben")[0] == 0
    status, _, err = sioms("key", "revoke", "ben")
    assert status == 1 and "no such key" in err
    status, _, err = sioms("serve", "--listen", "*:5770")
    assert status == 1 and "nobody may come in" in err and "sioms key allow" in err
    assert "want HOST:PORT" in sioms("serve", "--listen", "5770")[2]


def test_no_key_looks_like_an_option(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = iter([(b"-" + b"x" * 39, b"y" * 40), (b"z" * 40, b"y" * 40)])
    monkeypatch.setattr("zmq.curve_keypair", lambda: next(pairs))
    assert folder.new("kate").public == "z" * 40
