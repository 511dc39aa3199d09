"""Become ``sumo``, killed with the process that started it and, where possible, in its own network (Linux).

Run as a script, by path and with nothing but the standard library: ``leash.py PARENT TALK COMMAND ..``. PARENT is the
process id of its starter. TALK is a Unix socket, or -1 for a ``sumo`` that others connect to by its port. SUMO listens
on all interfaces until its clients are connected. In its own network namespace, it has its own loopback. The
connections to it that were made there go through TALK, or the word OPEN if the system allows no namespace.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import select
import signal
import socket
import struct
import sys
import time

OPEN, PRIVATE = b"open", b"private"
TRACI_CLIENTS = 2
_NEW_USER, _NEW_NETWORK = 0x10000000, 0x40000000  # CLONE_NEWUSER, CLONE_NEWNET
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG; survives exec, and ends with a change of credentials
_SET_FLAGS, _UP = 0x8914, 0x41  # SIOCSIFFLAGS; IFF_UP and IFF_RUNNING
RETRY_PERIOD_S = 0.005


def have_own_network() -> bool:
    """Move this process into its own network namespace, with a loopback that works.

    Returns:
        Whether that succeeded.
    """
    libc = ctypes.CDLL(None)
    if libc.unshare(_NEW_NETWORK) != 0 and libc.unshare(_NEW_USER | _NEW_NETWORK) != 0:
        return False
    try:
        with socket.socket() as any_socket:
            fcntl.ioctl(any_socket, _SET_FLAGS, struct.pack("16sh14x", b"lo", _UP))
    except OSError:
        return False
    return True


def send_connections(talk: socket.socket, port: int) -> None:
    """Connect to a port as soon as a program listens, and send the connections, unless the other end goes first.

    Args:
        talk: The socket to send them through.
        port: The port.
    """
    made: list[socket.socket] = []
    while len(made) < TRACI_CLIENTS:
        connection = socket.socket()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            connection.bind(("127.0.0.1", 0))
            if connection.getsockname()[1] == port:  # the kernel could connect such a socket to itself
                raise ConnectionRefusedError
            connection.connect(("127.0.0.1", port))
        except OSError:
            connection.close()
            if select.select([talk], [], [], RETRY_PERIOD_S)[0]:
                return
            time.sleep(RETRY_PERIOD_S)
        else:
            made.append(connection)
    socket.send_fds(talk, [PRIVATE], [connection.fileno() for connection in made])


def main(parent: int, talk_fd: int, command: list[str]) -> None:
    """Become the command; never returns.

    Args:
        parent: The process id of the starter.
        talk_fd: The Unix socket, or -1.
        command: The command of SUMO.
    """
    private = talk_fd >= 0 and have_own_network()
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)
    if talk_fd >= 0:
        talk = socket.socket(fileno=talk_fd)
        if not private:
            talk.sendall(OPEN)
        elif os.fork() == 0:
            if os.fork() == 0:  # a grandchild, which SUMO need not wait for
                os.closerange(0, 3)
                send_connections(talk, int(command[command.index("--remote-port") + 1]))
            os._exit(0)
        else:
            os.wait()
        talk.close()
    os.execv(command[0], command)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
