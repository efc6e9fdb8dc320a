"""The gateway, ``sioms serve``: the workcell for clients on other machines.

``core`` has the sessions: leases, numbers of frames, what is sent ahead; pure. ``serve`` is the loop around it,
``ways`` ends stops at the daemon. Transports are thin: ``zeromq`` with ``stops``, and ``zenoh``.
docs/decisions/0210-one-gateway-on-keys-and-leases.md, docs/decisions/0520-zenoh-beside-zeromq.md
"""
