"""Everything that two SIOMS processes must agree on: records, pages, messages.

The modules here know bytes, buffers and integers; none of them opens a file, a socket or a clock.
They import little, because the shell tools pay for every import in their start time: no numpy,
no dataclasses, no typing at run time.

* ``flags``     classes, control modes, status bits, requests, rights
* ``records``   the structs that ``write`` takes and the fields that ``read`` fills
* ``page``      the shared-memory page of one block of channels
* ``latch``     the emergency-stop latch
* ``stopfile``  the stop-request file, for stops that the daemon does not hear
* ``markers``   the marker table
* ``messages``  the msgpack messages on the Unix sockets
* ``nodeinfo``  what a node is: channels, units, limits, the record sizes
"""
