"""Every request on a handle with every right: a driver refuses what its user may not."""

from __future__ import annotations

import errno
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from sioms.protocol.flags import Request, Right
from sioms.sdk import requests

READS = {
    Request.WAIT_UNTIL_IDLE, Request.GET_LIMITS, Request.GET_GAINS, Request.GET_STATISTICS, Request.GET_DIAGNOSTICS,
    Request.WAIT_UNTIL_EVENT,
}  # fmt: skip
OTHERS = {
    Request.EMERGENCY_STOP: Right.STOP,
    Request.STOP: Right.STOP | Right.WRITE,
    Request.RESET: Right.WRITE | Right.ADMINISTER,
    Request.CANCEL_WAITS: Right.WRITE | Right.ADMINISTER,
}


@pytest.mark.parametrize("request_", list(Request), ids=lambda r: r.name)
def test_a_request_takes_its_right(request_: Request) -> None:
    needs = OTHERS.get(request_, Right.READ if request_ in READS else Right.WRITE)
    for bits in range(16):
        handle: Any = SimpleNamespace(
            node="io0",
            who="eva",
            uid=1000,
            exclusive=True,
            rights=Right(bits),
            block=MagicMock(),
            channels=np.array([0]),
            bit=0,
            number=1,
            passed_on=False,
            axes=[0],
            begins_anew=lambda axes: None,
        )
        runtime: Any = MagicMock()
        try:
            requests.ioctl(runtime, handle, 1, int(request_), None, None)
            refused = False
        except OSError as error:
            refused = error.errno == errno.EPERM
        assert refused is not bool(bits & needs), Right(bits)
        if refused:
            assert not runtime.mock_calls, "nothing was done"
