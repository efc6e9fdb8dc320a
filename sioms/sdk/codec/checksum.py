"""Checksums of the device protocols. Each is named as in the catalogue of CRC algorithms.

Check values over ``b"123456789"`` are in the tests. Table-driven where the standard library has no
such polynomial; CCITT comes from :mod:`binascii`, in C.
"""

from binascii import crc_hqx


def _reflected_table(polynomial: int) -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (polynomial if crc & 1 else 0)
        table.append(crc)
    return tuple(table)


def _straight_table(polynomial: int) -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (polynomial if crc & 0x8000 else 0)) & 0xFFFF
        table.append(crc)
    return tuple(table)


_MODBUS = _reflected_table(0xA001)
_UMTS = _straight_table(0x8005)


def crc16_modbus(data: bytes) -> int:
    """Return CRC-16/MODBUS (0x8005 reflected, initial 0xFFFF); low byte first on the wire.

    Example:
        >>> hex(crc16_modbus(b"123456789"))
        '0x4b37'
    """
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _MODBUS[(crc ^ byte) & 0xFF]
    return crc


def crc16_umts(data: bytes) -> int:
    """Return CRC-16/UMTS (0x8005, initial 0), used by Dynamixel 2.0; low byte first on the wire.

    Example:
        >>> hex(crc16_umts(b"123456789"))
        '0xfee8'
    """
    crc = 0
    for byte in data:
        crc = crc << 8 & 0xFF00 ^ _UMTS[crc >> 8 ^ byte]
    return crc


def crc16_ccitt_false(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE (0x1021, initial 0xFFFF); low byte first in the sample stream.

    Example:
        >>> hex(crc16_ccitt_false(b"123456789"))
        '0x29b1'
    """
    return crc_hqx(data, 0xFFFF)


def xor8(data: bytes) -> int:
    """Return the exclusive-or of all bytes, as in ``*hh`` at the end of an ASCII line.

    Example:
        >>> hex(xor8(b"1,2,3"))
        '0x30'
    """
    result = 0
    for byte in data:
        result ^= byte
    return result
