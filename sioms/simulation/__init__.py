"""Simulated devices as separate processes, each speaking its wire protocol over a pty or TCP port.

``python -m sioms.drivers.modbus.simulated.leadshine --link /tmp/drive`` prints ``ready PORT`` and serves until its
standard input, when that is a pipe, ends. Lines on standard input inject faults (see :mod:`.control`).
They are written from the vendors' facts and share no code with the drivers that they test.
"""
