"""Pure codecs: bytes to values and back. No I/O, no clock, no threads: time comes in as ``now_ns``."""
