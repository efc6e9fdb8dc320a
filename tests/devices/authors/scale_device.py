"""The scale as a process: ``python scale_device.py --link PATH``. Nothing of SIOMS is in it."""

from __future__ import annotations

import os
import select
import sys
import tty

master, slave = os.openpty()
tty.setraw(slave)
link = sys.argv[sys.argv.index("--link") + 1]
os.symlink(os.ttyname(slave), link)
print(f"ready {link}", flush=True)
heard = b""
while True:
    ready, _, _ = select.select([0, master], [], [])  # noqa: TID251
    if 0 in ready and not os.read(0, 1000):
        break
    if master in ready:
        heard = (heard + os.read(master, 100))[-20:]  # a line brings its characters one by one
        if heard.endswith(b"W\r"):
            text = b"+0012.340"
            value = 0
            for byte in text:
                value ^= byte
            os.write(master, text + b"*%02X\r\n" % value)
