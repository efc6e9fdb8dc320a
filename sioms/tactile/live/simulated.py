"""A prober's workcell with a simulated finger behind a real framed stream: processes of their own, that of
etc/prober.toml.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.resources import files
from pathlib import Path

import sioms
from sioms.children import Process, daemon
from sioms.tactile.live.prober import wait_links

FINGER = (
    "length_m = 0.012; gain = 3.0; gain_scatter = 0.1; depth_scatter_m = 2e-4; angle_scatter_rad = 0.007; quadratic = "
    "0.03; adhesion = 0.3; creep = 0.05; drift = 0.3; drift_s = 300.0; mains = 0.03; strip_gain = 0.02; seed = 1"
)
"""The finger that is probed if none is described: faults of the sizes that the dissertation reports."""


@contextmanager
def simulated(
    folder: Path, finger: str, radii_m: Sequence[float], text: str | None = None, hidden: Path | None = None
) -> Iterator[Callable[[float], None]]:
    """Run the prober's workcell with a simulated finger; give a function that mounts an indenter [m].

    Args:
        folder: for sockets and configuration; a short path.
        finger: fields of the simulated finger.
        radii_m: of the indenters.
        text: of the configuration; None takes etc/prober.toml.
        hidden: a file with further fields, which only the simulated finger reads.
    """
    port, socket = folder / "finger", folder / "prober.sock"
    with ExitStack() as stack:
        module = "sioms.drivers.framed_adc.simulated.finger"
        words = ["--link", str(port), "--socket", str(socket), "--finger", finger]
        words += [] if hidden is None else ["--finger-file", str(hidden)]
        device = Process([module, *words, "--mount", *(str(radius) for radius in radii_m)], "ready", told=True)
        stack.callback(device.end)
        config = folder / "prober.toml"
        source = text or files("sioms.tactile.live").joinpath("prober.toml").read_text(encoding="utf-8")
        config.write_text(source.replace("/dev/ttyACM0", str(port)), encoding="utf-8")
        before = os.environ.get("SIOMS_SOCKET")
        process = daemon(str(config), str(socket))
        stack.callback(process.end)
        try:
            with sioms.Workcell(name="prober") as cell:
                wait_links(cell)
            yield lambda radius_m: device.tell(f"indenter {radius_m}")
        finally:
            if before is None:
                del os.environ["SIOMS_SOCKET"]
            else:
                os.environ["SIOMS_SOCKET"] = before
