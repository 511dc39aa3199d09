"""The engine: a process of its own that holds the simulation, started by spawn.

It alone forks.  It never starts the sandbox, rich, httpx or SQLite; what it needs of those it asks its front for,
through one connection a fork ("slot"), and the front answers while it waits for the engine's result.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from sumo_adv.errors import OUT_OF_MEMORY, SimulationError, SumoAdvError, ran_out_of_memory

SLOTS = 2  # forks that run at once, unless told otherwise
QUIET_VARIABLES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

Answer = Callable[[Any], Any]
Body = Callable[[list[Connection]], Mapping[str, Callable[..., Any]]]


class Engine:
    """The front's handle. ``body`` (importable by name) makes the handlers inside the new process; ``slots`` forks run
    at once in it."""

    def __init__(self, body: Body, slots: int = SLOTS) -> None:
        self.at_once = slots
        self.lost = False  # its process has died
        context = multiprocessing.get_context("spawn")
        self._folder = tempfile.TemporaryDirectory(prefix="sumo_adv-engine-")  # the process may be killed: not its own
        self._log = Path(self._folder.name) / "log"
        self._log.touch()
        self._control, control = context.Pipe()
        pairs = [context.Pipe() for _ in range(slots)]
        self._slots = [p[0] for p in pairs]
        variables = {**QUIET_VARIABLES, "TMPDIR": self._folder.name}
        saved = {k: os.environ.get(k) for k in variables}
        os.environ.update(variables)
        try:
            self._process = context.Process(
                target=_serve, args=(body, control, [p[1] for p in pairs], str(self._log)), daemon=True
            )
            with _allowed_to_start():
                self._process.start()
        finally:
            for name, value in saved.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
        control.close()
        for _, child_end in pairs:
            child_end.close()

    def request(self, command: str, *arguments: Any, answer: Answer | None = None) -> Any:
        """Have the engine do something, answering its questions meanwhile.

        Raises:
            SumoAdvError: what the engine raised, or SimulationError if its process died.
        """
        with self._alive():
            self._control.send((command, arguments))
            while True:
                for ready in wait([self._control, *self._slots]):
                    assert isinstance(ready, Connection)
                    if ready is self._control:
                        return self._reply()
                    question = ready.recv()
                    ready.send(answer(question) if answer is not None else None)

    def converse(self, command: str, *arguments: Any, answer: Answer | None = None) -> Conversation:
        """Begin a command that sends a first message in the first slot, and then a reply to each message there.

        It goes on until it is told to end. Its own questions come in the other slots; ``answer`` answers them.

        Raises as ``request``.
        """
        return Conversation(self, (command, arguments), answer)

    def _reply(self) -> Any:
        kind, value = self._control.recv()
        if kind == "error":
            raise value
        return value

    @contextmanager
    def _alive(self) -> Iterator[None]:
        """Raises SimulationError where the process dies."""
        try:
            yield
        except (EOFError, BrokenPipeError, ConnectionResetError) as error:
            self.lost = True
            raise SimulationError(f"The simulation process ended unexpectedly{self._last_words()}.") from error

    def said(self) -> str:
        """What its process printed: SUMO's words, tracebacks."""
        return self._log.read_text(errors="replace")

    def _last_words(self) -> str:
        lines = [line for line in self.said().splitlines() if line.strip()]
        errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error:")] or lines
        return f" ({errors[-1][:300]})" if errors else ""

    def close(self) -> None:
        """End the process."""
        for connection in (self._control, *self._slots):
            connection.close()
        self._process.join(timeout=0.5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._folder.cleanup()

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Conversation:
    """A command of the engine that goes on until it is told to end. ``said``: what it said last."""

    def __init__(self, engine: Engine, order: tuple[str, tuple[Any, ...]], answer: Answer | None) -> None:
        self._engine, self._answer, self._over = engine, answer, False
        with engine._alive():
            engine._control.send(order)
        self.said = self._listen()

    def ask(self, message: Any) -> Any:
        """What the command says to a message.

        Raises:
            SumoAdvError: what ended the command; SimulationError if its process died, or the command has ended before.
        """
        if self._over:
            raise SimulationError("The command has ended, so it answers no more: begin another.")
        with self._engine._alive():
            self._engine._slots[0].send(message)
        self.said = self._listen()
        return self.said

    def _listen(self) -> Any:
        engine = self._engine
        first, *others = engine._slots
        with engine._alive():
            while True:
                ready = wait([first, *others, engine._control])
                if first in ready:
                    return first.recv()
                if engine._control in ready:
                    self._over = True
                    return engine._reply()
                for slot in others:
                    if slot in ready:
                        question = slot.recv()
                        slot.send(self._answer(question) if self._answer is not None else None)

    def end(self) -> None:
        """Tell the command to end; the engine is free for others then. May be called twice.

        Raises as ``ask``.
        """
        if self._over:
            return
        self._over, engine = True, self._engine
        with engine._alive():
            engine._slots[0].send(None)
            wait([engine._control])
            while engine._slots[0].poll():  # a reply that was not read: asking was interrupted
                engine._slots[0].recv()
            engine._reply()


@contextmanager
def _allowed_to_start() -> Iterator[None]:
    """Start a process from a daemonic one, such as a worker of a vectorised environment.

    ``multiprocessing`` refuses that because such a child would outlive a worker that is killed. The engine does not: it
    ends when its connection closes.
    """
    me = multiprocessing.current_process()
    daemonic = me.daemon
    if daemonic:
        me.daemon = False
    try:
        yield
    finally:
        if daemonic:
            me.daemon = True


def _serve(body: Body, control: Connection, slots: list[Connection], log: str) -> None:
    """The engine process: SUMO's words go into a file, Ctrl-C and SIGTERM are the front's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        words = os.open(log, os.O_WRONLY | os.O_APPEND)
    except FileNotFoundError:  # the front was interrupted and has removed it
        os._exit(0)
    sys.stdout.flush()
    os.dup2(words, 1)
    os.dup2(words, 2)
    handlers = body(slots)
    while True:
        try:
            command, arguments = control.recv()
        except EOFError:
            os._exit(0)  # nothing is left to write, and an interpreter that ends in good order keeps the front waiting
        log_size = Path(log).stat().st_size
        try:
            reply = ("value", handlers[command](*arguments))
        except SumoAdvError as error:
            reply = ("error", _with_words(error, log, log_size))
        except Exception as error:
            reply = ("error", _failed("The simulation", error))
            import traceback

            traceback.print_exc()
        control.send(reply)


def _failed(what: str, error: BaseException) -> SimulationError:
    sentence = f"{what} failed ({type(error).__name__}: {error})."
    return SimulationError(OUT_OF_MEMORY if ran_out_of_memory(error) else sentence)


def _with_words(error: SumoAdvError, log: str, start: int) -> SumoAdvError:
    """SUMO says what is wrong on stderr only: put its last error since byte ``start`` into the sentence."""
    words = Path(log).read_bytes()[start:].decode(errors="replace")
    errors = [line[7:] for line in words.splitlines() if line.startswith("Error: ")]
    if isinstance(error, SimulationError) and errors and errors[-1] not in str(error):
        return SimulationError(f"{str(error).rstrip('.')}: {errors[-1].strip()[:300]}")
    return error


@contextmanager
def deaf() -> Iterator[None]:
    """Processes started within it do not hear Ctrl-C, from their first instruction on. Ours gets a Ctrl-C or SIGTERM
    that came meanwhile at the end, so that no process is started half."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # starting it would unblock them
    received: list[int] = []  # SIGTERM is not blocked: processes inherit that, and SIGTERM ends them
    handlers = dict[int, Any]()
    if threading.current_thread() is threading.main_thread():  # another thread may get a Ctrl-C that is blocked here
        handlers = {k: h for k in (signal.SIGINT, signal.SIGTERM) if callable(h := signal.getsignal(k))}
    for number in handlers:
        signal.signal(number, lambda k, _: received.append(k))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if received:
            signal.raise_signal(received[0])


def can_fork() -> bool:
    """Whether attempts can be forked on this system."""
    return hasattr(os, "fork") and sys.platform.startswith("linux")


def in_forks(
    works: Sequence[Callable[[], Any]],
    reloaded: Callable[[Callable[[], Any]], Callable[[], Any]] | None = None,
    lost: Callable[[str], Any] | None = None,
) -> list[Any]:
    """Do each piece of work in a fork of its own, at the same time; results in order.

    reloaded: adds to a piece of work that it loads the simulation again first. A fork that dies is repeated with it.
    lost: makes a result of the sentence that says why a fork died, if it dies again when it is repeated.

    Raises:
        SimulationError: a fork died, and again when it was repeated, and there is no ``lost``; or its work failed.
    """
    results = _forked(works)
    if reloaded is not None:
        for k, (data, _) in enumerate(results):
            if not data:
                results[k] = _forked([reloaded(works[k])])[0]
    return [_result(data, _death(status, repeated=reloaded is not None), lost) for data, status in results]


def _forked(works: Sequence[Callable[[], Any]]) -> list[tuple[bytes, int]]:
    """What each fork wrote, nothing if it died, and its exit code: negative for the signal that killed it."""
    children = []
    gc.freeze()  # a collection in a child would write to every object's page, which the system then copies
    for work in works:
        inlet, outlet = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(inlet)
            _child(work, outlet)
        os.close(outlet)
        children.append((pid, inlet))
    results = []
    for pid, inlet in children:
        with os.fdopen(inlet, "rb") as pipe:
            data = pipe.read()
        results.append((data, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])))
    return results


def _child(work: Callable[[], Any], outlet: int) -> None:
    """Never returns: whatever goes wrong, a fork must not go on as a second engine."""
    try:
        try:
            data = pickle.dumps(("value", work()), protocol=pickle.HIGHEST_PROTOCOL)
        except SumoAdvError as error:
            data = pickle.dumps(("error", error))
        except BaseException as error:
            data = pickle.dumps(("error", _failed("An attempt", error)))
        with os.fdopen(outlet, "wb") as pipe:
            pipe.write(data)
    finally:
        os._exit(0)


def _result(data: bytes, death: str, lost: Callable[[str], Any] | None) -> Any:
    if not data:
        if lost is None:
            raise SimulationError(death)
        return lost(death)
    kind, value = pickle.loads(data)
    if kind == "error":
        raise value
    return value


def _death(status: int, *, repeated: bool) -> str:
    """Why a fork ended without a result, from its exit code."""
    again = ", also when the simulation was loaded again and the attempt repeated" if repeated else ""
    if status >= 0:
        return f"A forked attempt ended without a result (exit status {status}){again}."
    name = signal.Signals(-status).name
    crash = name in ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE", "SIGILL")
    sentence = "SUMO or the ego's driver crashed in a forked attempt" if crash else "A forked attempt was killed"
    return f"{sentence} ({name}){again}."
