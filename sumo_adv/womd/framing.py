"""Read and write TFRecord framing.

A frame is ``u64le length | u32le masked CRC of the length | data | u32le masked CRC of the data``. The checksum is
CRC-32C (Castagnoli, reflected polynomial 0x82F63B78). The checksum is linear. Long data are therefore cut into strips,
which numpy runs through the table in parallel and which the operator "append n zero bytes" joins.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from sumo_adv.errors import UsageError

CRC_POLYNOMIAL = 0x82F63B78
CRC_MASK_DELTA = 0xA282EAD8
MAX_RECORD_BYTES = 1 << 30  # maximum size of one record; real ones have about 1 MB
_HEAD = struct.Struct("<QI")
_STRIP_COUNT = 1024  # strips that are computed in parallel
_MIN_STRIPPED_BYTES = 4096  # data of at least this size are cut into strips
_ALL_ONES = 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class RecordFrame:
    """One record of a file.

    Attributes:
        number: Its number, from 0.
        data: Its bytes; None if they were skipped.
        intact: Whether the bytes match their checksum.
    """

    number: int
    data: bytes | None
    intact: bool


def read_frames(file: BinaryIO, name: str, skip: int = 0) -> Iterator[RecordFrame]:
    """Yield the records of a file one at a time.

    Args:
        file: The open file.
        name: The name of the file, for messages.
        skip: The number of records at the start that are yielded without their bytes.

    Yields:
        The records. ``intact`` is False for data that do not match their checksum.

    Raises:
        UsageError: The file ends inside a record, a length does not match its checksum (nothing can be found after
            that), or a length is above ``MAX_RECORD_BYTES``.
    """
    number = 0
    while head := file.read(_HEAD.size):
        if len(head) < _HEAD.size:
            raise UsageError(f"Record {number} of {name} is cut short: the file ends inside it; fetch the file again.")
        length, check = _HEAD.unpack(head)
        if masked_crc(head[:8]) != check:
            raise UsageError(
                f"Record {number} of {name} has a damaged length, so nothing after it can be read: fetch the file "
                "again, or give a TFRecord file."
            )
        if length > MAX_RECORD_BYTES:
            raise UsageError(
                f"Record {number} of {name} would be {length} bytes long: this is not a file of scenarios."
            )
        data = file.read(length + 4)
        if len(data) < length + 4:
            raise UsageError(f"Record {number} of {name} is cut short: the file ends inside it; fetch the file again.")
        if number < skip:
            yield RecordFrame(number, None, intact=True)
        else:
            body = data[:length]
            yield RecordFrame(number, body, masked_crc(body) == int.from_bytes(data[length:], "little"))
        number += 1


def frame(data: bytes) -> bytes:
    """Return ``data`` as one record of a TFRecord file."""
    length = len(data).to_bytes(8, "little")
    checks = [masked_crc(part).to_bytes(4, "little") for part in (length, data)]
    return length + checks[0] + data + checks[1]


def masked_crc(data: bytes) -> int:
    """Return TFRecord's masked CRC-32C of ``data``."""
    crc = crc32c(data)
    return (((crc >> 15) | (crc << 17)) + CRC_MASK_DELTA) & _ALL_ONES


def crc32c(data: bytes) -> int:
    """Return the CRC-32C of ``data``."""
    crc, rest = _ALL_ONES, data
    if len(data) >= _MIN_STRIPPED_BYTES:
        size = len(data) // _STRIP_COUNT
        strips = np.frombuffer(data, np.uint8, _STRIP_COUNT * size).reshape(_STRIP_COUNT, size)
        crc, rest = _join(_strip_crcs(strips), size), data[_STRIP_COUNT * size :]
    table = _table().tolist()
    for byte in rest:
        crc = table[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ _ALL_ONES


def _strip_crcs(strips: NDArray[np.uint8]) -> list[int]:
    """Return the register after each strip ``(k, n)``, starting with ones for the first and zeros for the others."""
    table = _table()
    register = np.zeros(len(strips), np.uint32)
    register[0] = _ALL_ONES
    for column in np.ascontiguousarray(strips.T):
        register = table[(register ^ column) & 0xFF] ^ (register >> 8)
    return [int(value) for value in register]


def _join(registers: list[int], size: int) -> int:
    """Return the register after all strips of ``size`` bytes: shift by one strip, then add the next."""
    a, b, c, d = _zero_bytes(size)
    crc = registers[0]
    for value in registers[1:]:
        crc = a[crc & 0xFF] ^ b[crc >> 8 & 0xFF] ^ c[crc >> 16 & 0xFF] ^ d[crc >> 24] ^ value
    return crc


@lru_cache(maxsize=1)
def _table() -> NDArray[np.uint32]:
    """Return the effect of one byte on the register."""
    table: NDArray[np.uint32] = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = (table >> np.uint32(1)) ^ (table & np.uint32(1)) * np.uint32(CRC_POLYNOMIAL)
    return table


@lru_cache(maxsize=64)
def _zero_bytes(size: int) -> tuple[list[int], list[int], list[int], list[int]]:
    """Return tables of "append ``size`` zero bytes" for the register's four bytes, lowest first (repeated squaring)."""
    bits = np.left_shift(np.uint32(1), np.arange(32, dtype=np.uint32))
    result, power = bits, _table()[bits & 0xFF] ^ (bits >> 8)  # images of the 32 single bits
    while size:
        if size & 1:
            result = _apply(power, result)
        power, size = _apply(power, power), size >> 1
    byte = np.arange(256, dtype=np.uint32)
    tables = [[int(v) for v in _apply(result, byte << np.uint32(8 * i))] for i in range(4)]
    return tables[0], tables[1], tables[2], tables[3]


def _apply(matrix: NDArray[np.uint32], vectors: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Apply a linear map over bits, given by the images of the single bits ``(32,)``, to each vector ``(n,)``."""
    chosen = (vectors[:, None] >> np.arange(32, dtype=np.uint32)) & 1
    return np.bitwise_xor.reduce(np.where(chosen == 1, matrix, np.uint32(0)), axis=1)
