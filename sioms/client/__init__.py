"""The client library: open nodes, read, write, ioctl, select; see ``sioms`` for the short names.

Nothing here imports numpy, asyncio, enum-heavy or socket-heavy modules unless it is used, because
the shell tools are made of it and start with every line of a script.
"""
