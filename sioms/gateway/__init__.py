"""The gateway, ``sioms serve``: the workcell for clients on other machines.

``core`` is what every transport has in common: sessions, leases, numbers of frames, what is sent ahead; pure. ``serve``
is ZeroMQ around it, ``stops`` the way of stops past it. Another transport is another loop around the same core.
docs/decisions/0210-one-gateway-on-keys-and-leases.md
"""
