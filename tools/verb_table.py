"""docs/protocol.md: every message and state of every socket, out of the verb table."""

from __future__ import annotations

import inspect

from sioms.protocol.driver_verbs import FROM_DRIVER, TO_DRIVER, TO_FORK_SERVER
from sioms.protocol.flags import OF_SOME_AXES, REQUESTS, Request, Right
from sioms.protocol.verbs import FROM_CLIENT, ON_HANDLE, Message, Socket

SOCKETS = {
    "Session: a client's connection to the daemon": (FROM_CLIENT,),
    "Handle: an open node, from the client to its driver": (ON_HANDLE,),
    "Control socket of a driver": (TO_DRIVER, FROM_DRIVER),
    "Control socket of the fork server": (TO_FORK_SERVER,),
}
HEAD = """# Messages

Generated from `sioms/protocol/verbs.py` and `driver_verbs.py` by `python -m sioms.tools.generate`; do not edit.

Every socket is a Unix SOCK_SEQPACKET socket, and a packet is one msgpack array: `[verb, number, arguments...]` for a request
or a notice, `[0, number, errno, value or text, zipped, as_of_ns]` for a reply (`sioms/protocol/messages.py`). A request has a
number above 0 that no unanswered request has; a notice has no reply. A message that is not in these tables, arrives
in a state in which it is not accepted, or has other arguments is malformed: it ends the connection on which it came, and nothing
else. A well-formed request that cannot be carried out is refused with an errno and a sentence; the connection remains open.
"""  # noqa: E501


def protocol_page() -> str:
    """Return the page."""
    lines = [HEAD, "```mermaid", "flowchart LR"]
    for sockets in SOCKETS.values():
        for socket in sockets:
            sender, receiver = (end.replace(" ", "_") for end in (socket.sender, socket.receiver))
            lines.append(f"    {sender} -->|{_folded([kind.__name__ for kind in socket.values()])}| {receiver}")
    lines += ["```", ""]
    for title, sockets in SOCKETS.items():
        lines += [f"## {title}", "", *_states(sockets)]
        for socket in sockets:
            lines += _table(socket)
    return "\n".join([*lines, *_requests()])


def _folded(names: list[str], width: int = 4) -> str:
    return "<br>".join(", ".join(names[at : at + width]) for at in range(0, len(names), width))


def _states(sockets: tuple[Socket, ...]) -> list[str]:
    """Draw the states of a connection that has several, and what leads from one to a later one."""
    states = sockets[0].states
    steps = [
        f"    {state} --> {kind.then}: {kind.__name__}"
        for socket in sockets for kind in socket.values() if kind.then
        for state in kind.states if states.index(state) < states.index(kind.then)
    ]  # fmt: skip
    if not steps:
        return []
    return [
        "```mermaid",
        "stateDiagram-v2",
        f"    [*] --> {states[0]}",
        *steps,
        f"    {states[-1]} --> [*]",
        "```",
        "",
    ]


def _table(socket: Socket) -> list[str]:
    lines = [
        f"From the {socket.sender} to the {socket.receiver}:", "",
        "| verb | message | arguments | accepted in state | right | |", "| ---: | --- | --- | --- | --- | --- |",
    ]  # fmt: skip
    for verb, kind in socket.items():
        fields = ", ".join(f"`{name}`: {kind_of.words.split(',')[0]}" for name, kind_of in kind.fields.items())
        states = "" if kind.states == socket.states else " or ".join(kind.states)
        name = f"{kind.__name__}{' (notice)' if kind.notice else ''}"
        lines.append(f"| {verb} | {name} | {fields} | {states} | {_right(kind)} | {_does(kind)} |")
    return [*lines, ""]


def _right(kind: type[Message]) -> str:
    return "any, somewhere" if kind.somewhere else _words(kind.right)


def _words(right: Right) -> str:
    return " or ".join((each.name or "").lower() for each in Right if each in right and each != Right.ALL)


def _does(kind: type[Message]) -> str:
    return " ".join(inspect.getdoc(kind).replace("``", "`").split())  # type: ignore[union-attr]


def _requests() -> list[str]:
    lines = [
        "## Requests of Ioctl",
        "",
        "(*) On axes the argument may be the index of an axis in the node, or a list of indices; without one it",
        "concerns all axes. A STOP with an index that is none stops all of them, and is then refused.",
        "",
        "| number | request | right | needs the output node | shown in readings | |",
        "| ---: | --- | --- | --- | --- | --- |",
    ]
    for number, (right, owns, looks, does) in REQUESTS.items():
        owner, shown = "yes" if owns else "", "" if looks else "yes"
        does += " (*)" if number in OF_SOME_AXES else ""
        lines.append(f"| {int(number)} | {Request(number).name} | {_words(right)} | {owner} | {shown} | {does} |")
    return [*lines, ""]
