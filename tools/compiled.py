"""What the compiled ``devin`` and ``devout`` share with the tools in Python, as C: layouts, messages, options, formats.

Made of the tables that everything else uses, so that nothing is said twice; ``sioms.native.build`` compiles it together
with ``sioms/native/attach.c`` and ``devin.c`` or ``devout.c``.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from struct import calcsize

from sioms.client.node_core import UNREADABLE
from sioms.protocol import page
from sioms.protocol.flags import (
    PROTOCOL_VERSION,
    READONLY,
    Access,
    AnalogStatus,
    NodeClass,
    PageState,
    Request,
    WriteFlag,
)
from sioms.protocol.messages import MAX_PACKET
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.records import READ, WRITE, WRITE_STRUCT
from sioms.protocol.socketpath import CELL, SYSTEM_PATH, VARIABLE
from sioms.protocol.verbs import Close, Hello, Ioctl, Keepalive, Open
from sioms.protocol.verbs import Write as WriteMessage

from . import columns, devin, devout, options, rows

TREE = Path(__file__).absolute().parents[1]
if TREE.name == "sioms":  # installed, or imported through the tree's link
    TREE = TREE.parent
_PROTOCOL = ("flags", "messages", "nodeinfo", "page", "records", "socketpath", "text", "verbs")
_CLIENT = {"devin": ("node_core",), "devout": ("channel", "node_core", "overdue", "stream")}
_TOOLS = {"devin": ("devin", "rows"), "devout": ("columns", "devout", "tokens")}


def program(tool: str) -> tuple[str, str]:
    """Return the texts in C of a tool."""
    return "sioms/native/attach.c", f"sioms/native/{tool}.c"


def sources(tool: str) -> tuple[str, ...]:
    """Return what a compiled tool is made of, and does the same as: with any other text of these, Python runs."""
    return (
        *program(tool),
        *(f"sioms/protocol/{name}.py" for name in _PROTOCOL),
        *(f"sioms/client/{name}.py" for name in _CLIENT[tool]),
        *(f"sioms/tools/{name}.py" for name in ("compiled", "options", "pipe", *_TOOLS[tool])),
    )


_C = {"I": "uint32_t", "Q": "uint64_t"}


def source(tool: str) -> str:
    """Return the C of the whole program of a tool."""
    texts = [(TREE / name).read_bytes() for name in sources(tool)]
    checksum = 0
    for text in texts:
        checksum = zlib.crc32(text, checksum)
    numbers = {
        "CHECKSUM": f"{checksum}u", "MOST_SOURCE": max(map(len, texts)), "MAX_PACKET": MAX_PACKET,
        "NODE_INFO": len(NodeInfo.__slots__), "HELLO_NUMBER": 1, "OPEN_NUMBER": 2,
        **{node_class.name: int(node_class) for node_class in NodeClass},
    }  # fmt: skip
    strings = {"TOOL": tool, "CELL_VARIABLE": CELL, "SOCKET_VARIABLE": VARIABLE, "SYSTEM_PATH": SYSTEM_PATH}
    lines = [
        "#define _GNU_SOURCE",
        "#include <stdint.h>",
        *_numbers(numbers),
        *_strings(strings),
        _bytes("HELLO", Hello(PROTOCOL_VERSION, tool).packed(1)),
        f"static const char *const SOURCES[] = {{{', '.join(map(_text, sources(tool)))}}};",
        f"static const struct {{ uint32_t first, last; }} UNPRINTABLE[] = {{{_unprintable()}{{~0u, ~0u}}}};",
        "static const struct option { char letter; int valued, for_all, whole; double low, high; } OPTIONS[] = {"
        f"{_options(tool)}{{0}}}};",
        *{"devin": _of_devin, "devout": _of_devout}[tool](),
    ]
    return "\n".join([*lines, *(text.decode() for text in texts[: len(program(tool))])])


def _of_devin() -> list[str]:
    numbers = {
        "PAGE_VERSION": page.VERSION, "PAGE_HEADER": page.HEADER_SIZE, "SLOT_HEADER": page.SLOT_HEADER,
        "FLAGS": list(READ[NodeClass.ANALOG]).index("flags"), "INVALID": int(AnalogStatus.INVALID),
        "DEFAULT_COUNT": devin.DEFAULT_COUNT,
        **{state.name: int(state) for state in (PageState.STARTING, PageState.GOOD, PageState.STALE)},
    }  # fmt: skip
    return [
        *_numbers(numbers),
        *_strings({"READONLY": READONLY, "MAGIC": page.MAGIC.decode()}),
        *_opening(Open("NODE", int(Access.READ), 0.0, 0.0)),
        f"struct page {{\n{''.join(map(_member, page.HEADER_FIELDS.items()))}}};",
        f"static const struct {{ uint32_t state; const char *text; }} STATES[] = {{{_states()}}};",
        "struct field { char letter; int class, row, real, digits; };",
        f"static const struct field FIELDS[] = {{{_fields()}{{0}}}};",
    ]


def _of_devout() -> list[str]:
    lease_s = devout.FROZEN_S
    numbers = {
        "WRITE_VERB": int(WriteMessage.verb), "REPLACE": int(WriteFlag.REPLACE), "APPEND": int(WriteFlag.APPEND),
        "LEASE_MS": round(1e3 * lease_s), "MOST_WHOLE": f"{columns.MOST_WHOLE}.0",
        "MODE_AT": _at(NodeClass.AXIS, "control_mode"),
        **{f"{node_class.name}_SIZE": each.size for node_class, each in WRITE_STRUCT.items()},
    }  # fmt: skip
    head, _, _ = Close(1 << 40).packed(3).partition(b"\xcf")
    return [
        *_numbers(numbers),
        *_opening(Open("NODE", int(Access.READ | Access.WRITE), 0.0, lease_s)),
        _bytes("CLOSE_HEAD", head),
        _bytes("KEEPALIVE", Keepalive().packed()),
        _bytes("WAIT_IDLE", Ioctl(int(Request.WAIT_UNTIL_IDLE), None, None).packed(2)),
        "struct column { char letter; int at, whole, quantity; uint32_t flag; };",
        f"static const struct column COLUMNS[] = {{{_columns()}{{0}}}};",
        f"static const struct column VALUE = {{0, {_at(NodeClass.ANALOG, 'data')}, 0, 0, 0}};",
        f"static const struct column BITS = {{0, {_at(NodeClass.BINARY, 'data')}, 1, 0, 0}};",
    ]


def _numbers(values: Mapping[str, object]) -> list[str]:
    return [f"#define {name} {value}" for name, value in values.items()]


def _strings(values: Mapping[str, str]) -> list[str]:
    return [f"#define {name} {_text(text)}" for name, text in values.items()]


def _opening(message: Open) -> list[str]:
    before, after = message.packed(2).split(b"\xa4NODE")
    return [_bytes("OPEN_HEAD", before), _bytes("OPEN_TAIL", after)]


def _at(node_class: NodeClass, column: str) -> int:
    """Return where in a record that is written a column begins."""
    codes = [each.code for name, each in WRITE[node_class].items()][: list(WRITE[node_class]).index(column)]
    return calcsize("<" + "".join(codes))


def _columns() -> str:
    found = ""
    for letter, name in columns.ORDER:
        column = WRITE[NodeClass.AXIS][name]
        facts = (
            _at(NodeClass.AXIS, name),
            int(column.code != "d"),
            int(letter in columns.QUANTITIES),
            int(column.flag),
        )
        found += f"{{'{letter}', {', '.join(map(str, facts))}}}, "
    return found


def _text(text: str) -> str:
    return f'"{text}"'


def _bytes(name: str, data: bytes) -> str:
    return f"static const unsigned char {name}[] = {{{', '.join(map(str, data))}}};"


def _member(field: tuple[str, str]) -> str:
    name, code = field
    return f"    {_C[code]} {name};\n" if code in _C else f"    char {name}[{code.removesuffix('s')}];\n"


def _states() -> str:
    return ", ".join(f"{{{int(state)}, {_text(text)}}}" for state, text in UNREADABLE.items())


def _unprintable() -> str:
    found, begin = "", -1
    for code in range(sys.maxunicode + 2):
        hidden = code <= sys.maxunicode and not chr(code).isprintable()
        if hidden and begin < 0:
            begin = code
        elif not hidden and begin >= 0:
            found, begin = f"{found}{{{begin}, {code - 1}}}, ", -1
    return found


def _fields() -> str:
    found = ""
    for node_class, fields in rows.FIELDS.items():
        names = list(READ[node_class])
        for letter, name, digits in fields:
            real = READ[node_class][name].code == "d"
            found += f"{{'{letter}', {int(node_class)}, {names.index(name)}, {int(real)}, {digits or 0}}}, "
    return found


def _options(tool: str) -> str:
    found = ""
    for option in options.TOOLS[tool]:
        if option.letter:
            low, high, _ = options.BOUNDS.get(option.value, (0, 0, ""))
            facts = (bool(option.value), option.scope == options.ALL, option.value != options.SECONDS)
            found += f"{{'{option.letter}', {', '.join(str(int(fact)) for fact in facts)}, {low}, {high}}}, "
    return found
