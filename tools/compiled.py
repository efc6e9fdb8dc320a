"""What the compiled ``devin`` shares with the tool in Python, as C: layouts, messages, options and formats.

Made of the tables that everything else uses, so that nothing is said twice; ``sioms.native.build`` compiles it together
with ``sioms/native/attach.c`` and ``devin.c``.
"""

from __future__ import annotations

import sys
import zlib
from pathlib import Path

from sioms.client.node_core import UNREADABLE
from sioms.protocol import page
from sioms.protocol.flags import PROTOCOL_VERSION, READONLY, Access, AnalogStatus, NodeClass, PageState
from sioms.protocol.messages import MAX_PACKET
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.records import READ
from sioms.protocol.socketpath import CELL, SYSTEM_PATH, VARIABLE
from sioms.protocol.verbs import Hello, Open

from . import devin, options, rows

TREE = Path(__file__).absolute().parents[1]
if TREE.name == "sioms":  # installed, or imported through the tree's link
    TREE = TREE.parent
_PROTOCOL = ("flags", "messages", "nodeinfo", "page", "records", "socketpath", "text", "verbs")
_PROGRAM = ("sioms/native/attach.c", "sioms/native/devin.c")
SOURCES = (
    *_PROGRAM,
    *(f"sioms/protocol/{name}.py" for name in _PROTOCOL),
    "sioms/client/node_core.py",
    *(f"sioms/tools/{name}.py" for name in ("compiled", "devin", "options", "pipe", "rows")),
)  # fmt: skip
"""What the program is made of, and what it does the same as: with any other text of these, Python runs."""
_C = {"I": "uint32_t", "Q": "uint64_t"}


def source() -> str:
    """Return the C of the whole program."""
    texts = [(TREE / name).read_bytes() for name in SOURCES]
    checksum = 0
    for text in texts:
        checksum = zlib.crc32(text, checksum)
    before, after = Open("NODE", int(Access.READ), 0.0, 0.0).packed(2).split(b"\xa4NODE")
    numbers = {
        "CHECKSUM": f"{checksum}u", "MOST_SOURCE": max(map(len, texts)), "MAX_PACKET": MAX_PACKET,
        "PAGE_VERSION": page.VERSION, "PAGE_HEADER": page.HEADER_SIZE, "SLOT_HEADER": page.SLOT_HEADER,
        "NODE_INFO": len(NodeInfo.__slots__), "BINARY": int(NodeClass.BINARY), "ANALOG": int(NodeClass.ANALOG),
        "FLAGS": list(READ[NodeClass.ANALOG]).index("flags"), "INVALID": int(AnalogStatus.INVALID),
        "DEFAULT_COUNT": devin.DEFAULT_COUNT,
        "HELLO_NUMBER": 1, "OPEN_NUMBER": 2,
        **{state.name: int(state) for state in (PageState.STARTING, PageState.GOOD, PageState.STALE)},
    }  # fmt: skip
    texts_of = {"READONLY": READONLY, "CELL_VARIABLE": CELL, "SOCKET_VARIABLE": VARIABLE, "SYSTEM_PATH": SYSTEM_PATH}
    lines = [
        "#define _GNU_SOURCE",
        "#include <stdint.h>",
        *(f"#define {name} {value}" for name, value in numbers.items()),
        *(f"#define {name} {_text(text)}" for name, text in texts_of.items()),
        f"#define MAGIC {_text(page.MAGIC.decode())}",
        _bytes("HELLO", Hello(PROTOCOL_VERSION, "devin").packed(1)),
        _bytes("OPEN_HEAD", before),
        _bytes("OPEN_TAIL", after),
        f"static const char *const SOURCES[] = {{{', '.join(map(_text, SOURCES))}}};",
        f"struct page {{\n{''.join(map(_member, page.HEADER_FIELDS.items()))}}};",
        f"static const struct {{ uint32_t state; const char *text; }} STATES[] = {{{_states()}}};",
        f"static const struct {{ uint32_t first, last; }} UNPRINTABLE[] = {{{_unprintable()}{{~0u, ~0u}}}};",
        "struct field { char letter; int class, row, real, digits; };",
        f"static const struct field FIELDS[] = {{{_fields()}{{0}}}};",
        "static const struct option { char letter; int valued, for_all, whole; double low, high; } OPTIONS[] = {"
        f"{_options()}{{0}}}};",
    ]
    return "\n".join([*lines, *(text.decode() for text in texts[: len(_PROGRAM)])])


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


def _options() -> str:
    found = ""
    for option in options.TOOLS["devin"]:
        if option.letter:
            low, high, _ = options.BOUNDS.get(option.value, (0, 0, ""))
            facts = (bool(option.value), option.scope == options.ALL, option.value != options.SECONDS)
            found += f"{{'{option.letter}', {', '.join(str(int(fact)) for fact in facts)}, {low}, {high}}}, "
    return found
