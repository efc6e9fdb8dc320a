"""Bridges to what laboratories already run, each a small module over the client library and an extra of its own.

``metrics`` is the exporter for Prometheus, ``epics`` shows nodes over PV Access. A bridge is an ordinary client of the
daemon: nothing waits for it, and what it held halts when it ends.
"""
