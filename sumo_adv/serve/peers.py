"""Find out who owns the other end of a connection within this machine (Linux).

TraCI has no log-in. A client on this machine is admitted if its socket belongs to the user who runs ``serve``, or to
root.

Source: proc(5), ``/proc/net/tcp`` and ``tcp6``: local and remote address, state and user are in columns 2, 3, 4 and 8.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import sys
from pathlib import Path

TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
ROOT = 0  # may do anything in any case
ESTABLISHED = "01"  # sockets in other states have no owner: the system writes user 0 for them
_ADDRESS_WORD_BYTES = 4  # the table writes this many bytes as one number, in the machine's byte order


def is_ours(connection: socket.socket) -> bool:
    """Return whether this user, or root, owns the other end of a connection within this machine.

    Args:
        connection: The connection.

    Returns:
        The answer; True if the system does not say (macOS, Windows).
    """
    if not any(table.is_file() for table in TABLES):
        return True
    return _user(connection.getpeername(), connection.getsockname()) in (os.getuid(), ROOT)


def _user(local: tuple[str, int], remote: tuple[str, int]) -> int | None:
    """Return the user of the open socket with these addresses; None if there is none."""
    wanted = {(a, b) for a in _written(*local[:2]) for b in _written(*remote[:2])}
    for table in TABLES:
        rows = table.read_text().splitlines()[1:] if table.is_file() else []
        for _, at, to, state, _, _, _, user, *_ in map(str.split, rows):
            if state == ESTABLISHED and (at, to) in wanted:
                return int(user)
    return None


def _written(host: str, port: int) -> tuple[str, ...]:
    """Return an address as the tables write it; an IPv4 address may appear in either table."""
    address = ipaddress.ip_address(host.partition("%")[0])
    short = address if isinstance(address, ipaddress.IPv4Address) else address.ipv4_mapped
    long = address if short is None else ipaddress.IPv6Address(f"::ffff:{short}")
    return tuple(f"{_hexadecimal(each.packed)}:{port:04X}" for each in (short, long) if each is not None)


def _hexadecimal(packed: bytes) -> str:
    """Return an address in the table's hexadecimal form."""
    words = [packed[k : k + _ADDRESS_WORD_BYTES] for k in range(0, len(packed), _ADDRESS_WORD_BYTES)]
    return "".join(f"{int.from_bytes(word, sys.byteorder):08X}" for word in words)
