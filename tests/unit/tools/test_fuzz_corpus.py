"""Each decoder takes its seeds, what was once found, and random changes of both, without anything but what it may
raise.
"""

from __future__ import annotations

import random
import time
from struct import pack

import pytest

from sioms.bench.decoders import TARGETS, feed
from sioms.bench.search import changed

FRAMES, RECORDED = (TARGETS[name].seeds[0] for name in ("gateway", "recording of a workcell"))
FOUND: dict[str, list[bytes]] = {
    "message": [
        b"\x91" * 30_000,
        b"\xdd\xff\xff\xff\xff",
        b"\xc7\x00\x05",
        b"\x93\x01\x01\xa3\xed\xa0\x80",
        b"\x92\x01" + b"\x91" * 1015,
    ],
    "toml": [b"x = " + b"[" * 2000, b"x = " + b"9" * 5000, b"\xff"],
    "json": [b"[" * 100_000, b'{"a":' * 2000],
    "config": [
        b"[device.a]\ndriver = 'b'\nx = " + b"[" * 2000 + b"]" * 2000,
        b"device = 1979-05-27\n",
        b"[device]\n[[node]]\n",
    ],
    "trace": [b"\xff\n\n", b'{"sioms_trace": 1}\n{"t": "1", "n": [], "b": "", "d": "<"}\n', b"[" * 100_000],
    "journal of stops": [
        b'{"at":1,"node":"n","device":"d","block":"b","parts":[[0,1000000000000,1]],"stop":true,"by":"a"}\n',
        b'{"at":1,"node":"n","device":"d","block":"b","parts":[[0,0,' + b"9" * 4000 + b']],"stop":true,"by":"a"}\n',
        b'{"at":' + b"9" * 400 + b',"workcell":"","stop":true,"by":"a"}\n',
        b'{"checkpoint":[],"from":1e999}\n',
    ],
    "gateway": [FRAMES.replace(pack(">d", 0.1), pack(">d", lease_s)) for lease_s in (1e-12, -1.0, float("inf"))],
    "recording of a workcell": [
        RECORDED.replace(good, bad)
        for good, bad in (
            (b"1" + b"0" * 18, b"x" * 19),
            (b'["x", 3', b"[[ ], 3"),
            (b"], -1, ", b"], [], "),
            (b"], -1, ", b"], 1e9, "[:7]),
            (b'[["a"', b"[[[ ]"),
            (b'{"stop"', b'["stop"'),
        )
    ],
}
"""What broke a decoder, or would have."""
SPAN_S, MOST = 0.3, 500


@pytest.mark.parametrize("name", TARGETS)
def test_decoder(name: str) -> None:
    target, chance = TARGETS[name], random.Random(name)
    begin = [*target.seeds, *FOUND.get(name, [])]
    taken = [feed(target, data) for data in begin]
    assert any(taken), "at least one seed is good"
    until = time.monotonic() + SPAN_S
    for _ in range(MOST):
        feed(target, changed(chance, chance.choice(begin)))
        if time.monotonic() > until:
            break
