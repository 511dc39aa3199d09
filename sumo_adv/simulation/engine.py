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
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar

from sumo_adv.errors import OUT_OF_MEMORY, DriverError, SimulationError, SumoAdvError, ran_out_of_memory
from sumo_adv.files import scratch_prefix
from sumo_adv.simulation.warnings_log import warnings_in
from sumo_adv.simulation.watch import LOOK, SIZE, Call, Watch, keep

SLOTS = 2  # forks that run at once, unless told otherwise
QUIET_VARIABLES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

ASIDE = "aside"  # beside the log
MOST_ASIDE = 1 << 20  # bytes of what attempts have printed, after which it begins anew

Reply = Callable[[Any], Any]
"""What the front says to a question of the process."""
W = TypeVar("W", covariant=True)
P = ParamSpec("P")
R = TypeVar("R")
Message = tuple[str, tuple[Any, ...], dict[str, Any]]
"""A method's name, its positional and its named arguments, as they are sent."""


class Engine(Generic[W]):
    """The front's handle of an engine process that holds one worker.

    A call names a method of the worker, as ``engine.call(EpisodeCalls.seek, "")``: type checkers compare its arguments
    with the method's, and the process calls the method of that name. The front need not import the worker's class; a
    protocol with its methods does.

    Attributes:
        at_once: How many forks run at once in the process.
        lost: Whether the process has died.
        talks: Whether a conversation goes on.
        asked: Whether a call has no result yet, because its caller was interrupted.
    """

    def __init__(self, worker: Callable[[list[Connection]], W], slots: int = SLOTS) -> None:
        """Start the process.

        Args:
            worker: Makes the worker in the new process, from the connections of its forks to the front. It must be
                importable by name.
            slots: How many forks run at once.
        """
        self.at_once = slots
        self.lost = self.talks = self.asked = False
        self._owed = 0  # results of calls that were posted
        self._heard = 0  # bytes of the log that belong to earlier episodes
        context = multiprocessing.get_context("spawn")
        self._folder = tempfile.TemporaryDirectory(prefix=scratch_prefix())  # the process may be killed: not its own
        self._log = Path(self._folder.name) / "log"
        self._log.touch()
        self._aside = self._log.with_name(ASIDE)
        self._aside.touch()
        note = Path(self._folder.name) / "calls"
        note.write_bytes(bytes(SIZE))
        self._watch = Watch(note)
        self._control, control = context.Pipe()
        leash, self._leash = context.Pipe(duplex=False)
        pairs = [context.Pipe() for _ in range(slots)]
        self._slots = [p[0] for p in pairs]
        variables = {**QUIET_VARIABLES, "TMPDIR": self._folder.name}
        saved = {k: os.environ.get(k) for k in variables}
        os.environ.update(variables)
        try:
            self._process = context.Process(
                target=_serve, args=(worker, control, [p[1] for p in pairs], str(self._log), note, leash), daemon=True
            )
            with _allowed_to_start():
                self._process.start()
        finally:
            for name, value in saved.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
        control.close()
        leash.close()
        for _, child_end in pairs:
            child_end.close()

    def call(self, method: Callable[Concatenate[W, P], R], *arguments: P.args, **named: P.kwargs) -> R:
        """Call a method of the worker.

        Returns:
            What the method returns.

        Raises:
            SumoAdvError: The method raised it.
            SimulationError: The process died, or the method raised another error.
        """
        result: R = self._result((method.__name__, arguments, named), None)
        return result

    def call_answering(
        self, reply: Reply, method: Callable[Concatenate[W, P], R], *arguments: P.args, **named: P.kwargs
    ) -> R:
        """Call a method of the worker, and answer the questions that it or its forks ask meanwhile; see ``call``."""
        result: R = self._result((method.__name__, arguments, named), reply)
        return result

    def _result(self, message: Message, reply: Reply | None) -> Any:
        self.asked = True
        with self._alive():
            self._order(message)
            while True:
                for ready in self._ready(self._control, *self._slots):
                    if ready is self._control:
                        self.asked = False
                        return self._returned()
                    question = ready.recv()
                    ready.send(reply(question) if reply is not None else None)

    def converse(
        self, reply: Reply | None, method: Callable[Concatenate[W, P], None], *arguments: P.args, **named: P.kwargs
    ) -> Conversation:
        """Call a method that the front directs by messages in the first slot.

        The method sends a first message there, and then one message for each that it receives. It returns when it
        receives None. Its questions come in the other slots, and ``reply`` answers them. Raises as ``call``.
        """
        return Conversation(self, (method.__name__, arguments, named), reply)

    def post(self, method: Callable[Concatenate[W, P], None], *arguments: P.args, **named: P.kwargs) -> None:
        """Call a method without waiting until it returns. The next call raises what the method raises.

        What the process prints from now on belongs to a new episode. Raises SimulationError if the process died.
        """
        self.begin_words()
        with self._alive():
            self._order((method.__name__, arguments, named))
        self._owed += 1

    def begin_words(self) -> None:
        """Let its words from now on be those of an episode of their own."""
        self._heard = self._log.stat().st_size
        self._aside.write_bytes(b"")

    def _order(self, message: Message) -> None:
        while self._owed:
            self._owed -= 1
            self._returned()
        self._control.send(message)

    def _returned(self) -> Any:
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
            call = self._watch.running()
            if call is not None and not call.is_sumo:
                self._process.join(LOOK)
                raise DriverError(call.ended(how(self._process.exitcode))) from error
            raise SimulationError(f"The simulation process ended unexpectedly{self._last_words()}.") from error

    def _ready(self, *connections: Connection) -> list[Connection]:
        """Those of the connections that can be read, as soon as there is one.

        Raises DriverError if code of others in the process is overdue, SimulationError if SUMO is; the process is
        killed then. EOFError if it has ended while a process that it left behind holds the connections.
        """
        while not (ready := wait(connections, LOOK)):
            if (call := self._watch.overdue()) is not None:
                self._kill()
                self.lost = True
                raise _late(call)
            if not self._process.is_alive() and not wait(connections, 0):
                raise EOFError
        return [each for each in ready if isinstance(each, Connection)]

    def said(self) -> str:
        """What its process printed in this episode: SUMO's words, tracebacks; then what attempts printed."""
        apart = self._aside.read_bytes() if self._aside.is_file() else b""
        return (self._log.read_bytes()[self._heard :] + apart).decode(errors="replace")

    def warnings(self) -> tuple[str, ...]:
        """What SUMO has warned of in this episode, but for attempts and repetitions."""
        return warnings_in(self._log.read_bytes()[self._heard :].decode(errors="replace"))

    def _last_words(self) -> str:
        lines = [line for line in self.said().splitlines() if line.strip()]
        errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error:")] or lines
        return f" ({errors[-1][:300]})" if errors else ""

    def close(self) -> None:
        for connection in (self._control, self._leash, *self._slots):
            connection.close()
        self._process.join(timeout=0.5)
        self._kill()
        self._process.join()
        self._folder.cleanup()

    def _kill(self) -> None:
        """End the process, and those that code of others has left behind in its group."""
        if hasattr(os, "killpg") and self._process.pid is not None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Conversation:
    """A call that goes on until it is told to end. ``said``: the last message from it."""

    def __init__(self, engine: Engine[Any], message: Message, reply: Reply | None) -> None:
        self._engine, self._reply, self._over = engine, reply, False
        with engine._alive():
            engine._order(message)
        engine.talks = True
        self.said = self._listen()

    def ask(self, message: Any) -> Any:
        """What the command says to a message. Raises SumoAdvError: what ended the command; SimulationError if its
        process died, or the command has ended before."""
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
                ready = engine._ready(first, *others, engine._control)
                if first in ready:
                    return first.recv()
                if engine._control in ready:
                    self._over, engine.talks = True, False
                    return engine._returned()
                for slot in ready:
                    question = slot.recv()
                    slot.send(self._reply(question) if self._reply is not None else None)

    def end(self) -> None:
        """Tell the command to end; the engine is free for others then. May be called twice. Raises as ``ask``."""
        if self._over:
            return
        self._over, engine = True, self._engine
        with engine._alive():
            engine._slots[0].send(None)
            engine._ready(engine._control)
            engine.talks = False
            while engine._slots[0].poll():  # a reply that was not read: asking was interrupted
                engine._slots[0].recv()
            engine._returned()


@contextmanager
def _allowed_to_start() -> Iterator[None]:
    """Start a process from a daemonic one, such as a worker of a vectorised environment.

    ``multiprocessing`` refuses that because such a child would outlive a worker that is killed. The engine does not: it
    ends when its connection closes.
    """
    me = multiprocessing.current_process()
    daemonic, me.daemon = me.daemon, False
    try:
        yield
    finally:
        me.daemon = daemonic


def _serve(
    make_worker: Callable[[list[Connection]], object], control: Connection, slots: list[Connection], log: str,
    note: Path, front: Connection,
) -> None:  # fmt: skip
    """The engine process: SUMO's words go into a file, Ctrl-C and SIGTERM are the front's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    end_with(front)
    try:
        words = os.open(log, os.O_WRONLY | os.O_APPEND)
        files = (Path(log), Path(log).with_name(ASIDE))
        _Aside.file = os.open(files[1], os.O_WRONLY | os.O_APPEND)
        keep(Watch(note))
    except FileNotFoundError:  # the front was interrupted and has removed it
        os._exit(0)
    sys.stdout.flush()
    os.dup2(words, 1)
    os.dup2(words, 2)
    worker = make_worker(slots)
    while True:
        try:
            method, arguments, named = control.recv()
        except EOFError:
            os._exit(0)  # nothing is left to write, and an interpreter that ends in good order keeps the front waiting
        log_sizes = [file.stat().st_size for file in files]
        try:
            reply = ("value", getattr(worker, method)(*arguments, **named))
        except SumoAdvError as error:
            since = b"".join(file.read_bytes()[size:] for file, size in zip(files, log_sizes, strict=True))
            reply = ("error", _with_words(error, since.decode(errors="replace")))
        except Exception as error:
            reply = ("error", _failed("The simulation", error))
            import traceback

            traceback.print_exc()
        _mend()
        control.send(reply)


def end_with(front: Connection) -> None:
    """Make a process group of this process and its children to come, which is killed when the other end of ``front``,
    which nobody else has, closes: when the process that has it ends, however it ends.

    A process of its own sees to it, since Python does nothing while SUMO works. Nothing happens where none can be
    forked (Windows): there this process ends when it next reads its connection.
    """
    if not hasattr(os, "fork"):
        return
    os.setpgid(0, 0)
    me, (inlet, outlet) = os.getpid(), os.pipe()
    if os.fork() == 0:
        os.close(outlet)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        ended = wait([front, inlet])
        if front in ended:
            os.killpg(me, signal.SIGKILL)
        os._exit(0)  # this process has ended by itself
    os.close(inlet)  # ``outlet`` stays open as long as this process or a fork of it


def _late(call: Call) -> SimulationError:
    return SimulationError(call.late()) if call.is_sumo else DriverError(call.late())


def _failed(what: str, error: BaseException) -> SimulationError:
    sentence = f"{what} failed ({type(error).__name__}: {error})."
    return SimulationError(OUT_OF_MEMORY if ran_out_of_memory(error) else sentence)


def _with_words(error: SumoAdvError, words: str) -> SumoAdvError:
    """SUMO says what is wrong on stderr only: put its last error into the sentence."""
    errors = [line[7:] for line in words.splitlines() if line.startswith("Error: ")]
    if isinstance(error, SimulationError) and errors and errors[-1] not in str(error):
        return SimulationError(f"{str(error).rstrip('.')}: {errors[-1].strip()[:300]}")
    return error


class _Aside:
    """The file of this engine process for what SUMO prints of attempts and repetitions; None elsewhere."""

    file: int | None = None


@contextmanager
def aside() -> Iterator[None]:
    """What SUMO prints within it is of an attempt, or repeats what it has printed: it is kept apart, and no warning of
    the episode's."""
    if _Aside.file is None:
        yield
        return
    if os.fstat(_Aside.file).st_size > MOST_ASIDE:
        os.ftruncate(_Aside.file, 0)
    kept = [os.dup(1), os.dup(2)]
    sys.stdout.flush()
    for number in (1, 2):
        os.dup2(_Aside.file, number)
    try:
        yield
    finally:
        sys.stdout.flush()
        for number, file in zip((1, 2), kept, strict=True):
            os.dup2(file, number)
            os.close(file)


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
    works: Sequence[Callable[[], Any]], reloaded: Callable[[Callable[[], Any]], Callable[[], Any]] | None = None,
    lost: Callable[[str], Any] | None = None, memory: float = 0.0,
) -> list[Any]:  # fmt: skip
    """Do each piece of work in a fork of its own, at the same time; results in order.

    reloaded: adds to a piece of work that it loads the simulation again first. A fork that dies is repeated with it.
        A fork is not repeated if it was killed because code of others did not return in time.
    lost: makes a result of the sentence that says why a fork died, if it dies again when it is repeated.
    memory: what a fork may use beyond what it begins with [MiB]; 0: without bound.

    Raises SimulationError: a fork died, and again when it was repeated, and there is no ``lost``; or its work failed.
    DriverError if code of others ran in it then.
    """
    ends = _forked(works, memory)
    if reloaded is not None:
        for k, end in enumerate(ends):
            if not end.data and not end.late:
                ends[k] = _forked([reloaded(works[k])], memory)[0]
    return [_result(end, lost, repeated=reloaded is not None) for end in ends]


@dataclass(frozen=True, slots=True)
class _End:
    """What a fork wrote, nothing if it died; its exit code, negative for the signal that killed it; the call of code of
    others that it died in, and whether it was killed because that was late."""

    data: bytes
    status: int
    call: Call | None
    late: bool


def _forked(works: Sequence[Callable[[], Any]], memory: float) -> list[_End]:
    children = []
    _mend()
    gc.freeze()  # a collection in a child would write to every object's page, which the system then copies
    for work in works:
        watch = Watch()
        inlet, outlet = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(inlet)
            keep(watch)
            _child(work, outlet, memory)
        os.close(outlet)
        children.append((pid, inlet, watch))
    late: set[int] = set()
    written = _all_written({inlet: (pid, watch) for pid, inlet, watch in children}, late)
    ends = []
    for pid, inlet, watch in children:
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        ends.append(_End(written[inlet], status, watch.running(), pid in late))
    return ends


def _mend() -> None:
    """Undo what code of others may have done to this process that it and its forks cannot live with: children of which
    the system says nothing, and closed standard files, whose numbers a fork's pipe would get."""
    if hasattr(signal, "SIGCHLD"):
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None or getattr(sys, name).closed:
            setattr(sys, name, os.fdopen(number, "w", closefd=False))


def _has_ended(pid: int) -> bool:
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _all_written(children: Mapping[int, tuple[int, Watch]], late: set[int]) -> dict[int, bytes]:
    """What comes out of each pipe until its child closes it, or has ended and a process that it left behind holds it. A
    child whose call is overdue is killed, and noted."""
    parts: dict[int, list[bytes]] = {inlet: [] for inlet in children}
    open_ones = set(children)
    while open_ones:
        ready = wait(open_ones, LOOK)
        for ended in () if ready else [each for each in open_ones if _has_ended(children[each][0])]:
            if not wait([ended], 0):
                os.close(ended)
                open_ones.discard(ended)
        for inlet in ready:
            assert isinstance(inlet, int)
            part = os.read(inlet, 1 << 20)
            if part:
                parts[inlet].append(part)
            else:
                os.close(inlet)
                open_ones.discard(inlet)
        for inlet in open_ones:
            pid, watch = children[inlet]
            if pid not in late and watch.overdue() is not None:
                late.add(pid)
                os.kill(pid, signal.SIGKILL)
    return {inlet: b"".join(each) for inlet, each in parts.items()}


@contextmanager
def _bounded(memory: float) -> Iterator[None]:
    """Bound what this process may allocate beyond what it has [MiB], where the system can; 0: do not."""
    status = Path("/proc/self/status")
    if not memory or not status.is_file():
        yield
        return
    import resource

    data = next(line for line in status.read_text().splitlines() if line.startswith("VmData:"))
    before = resource.getrlimit(resource.RLIMIT_DATA)
    bound = int(data.split()[1]) * 1024 + int(memory * 2**20)
    resource.setrlimit(resource.RLIMIT_DATA, (bound, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _child(work: Callable[[], Any], outlet: int, memory: float) -> None:
    """Never returns: whatever goes wrong, a fork must not go on as a second engine."""
    try:
        try:
            with aside(), _bounded(memory):
                value = work()
            data = pickle.dumps(("value", value), protocol=pickle.HIGHEST_PROTOCOL)
        except SumoAdvError as error:
            data = pickle.dumps(("error", error))
        except BaseException as error:
            data = pickle.dumps(("error", _failed("An attempt", error)))
        with os.fdopen(outlet, "wb") as pipe:
            pipe.write(data)
    finally:
        os._exit(0)


def _result(end: _End, lost: Callable[[str], Any] | None, *, repeated: bool) -> Any:
    if end.data:
        kind, value = pickle.loads(end.data)
        if kind == "error":
            raise value
        return value
    error = _death(end, repeated=repeated)
    if lost is None:
        raise error
    return lost(str(error))


def how(exitcode: int | None) -> str:
    """An exit code in words."""
    if exitcode is None or exitcode >= 0:
        return f"exit status {exitcode}"
    try:
        return f"killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"killed by signal {-exitcode}"


def _death(end: _End, *, repeated: bool) -> SimulationError:
    """Why a fork ended without a result."""
    again = ", also when the simulation was loaded again and the attempt repeated" if repeated else ""
    if end.call is not None and end.late:
        return _late(end.call)
    if end.call is not None and not end.call.is_sumo:
        return DriverError(end.call.ended(f"{how(end.status)}{again}"))
    if end.status >= 0:
        return SimulationError(f"A forked attempt ended without a result (exit status {end.status}){again}.")
    name = signal.Signals(-end.status).name
    crash = name in ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE", "SIGILL")
    sentence = "SUMO or the ego's driver crashed in a forked attempt" if crash else "A forked attempt was killed"
    return SimulationError(f"{sentence} ({name}){again}.")
