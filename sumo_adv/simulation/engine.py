"""The engine: a separate process that holds the simulation. This module is the front's side of it.

The process is started by spawn, and only this process forks. It never starts the sandbox, rich, httpx or SQLite. If it
needs something from them, it asks its front through one connection for each fork ("slot"). The front answers while it
waits for the engine's result.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar

from sumo_adv.errors import DriverError, SimulationError
from sumo_adv.files import scratch_prefix
from sumo_adv.simulation.engine_log import EngineLog
from sumo_adv.simulation.engine_process import serve
from sumo_adv.simulation.processes import SINGLE_THREAD_VARIABLES, allowed_from_daemons, environment, exit_in_words
from sumo_adv.simulation.watch import NOTE_BYTES, WATCH_INTERVAL_S, Watch

DEFAULT_SLOTS = 2  # default number of forks that run at once

Reply = Callable[[Any], Any]
"""Returns the front's answer to a question of the process."""
W = TypeVar("W", covariant=True)
P = ParamSpec("P")
R = TypeVar("R")
Message = tuple[str, tuple[Any, ...], dict[str, Any]]
"""A method's name, its positional arguments and its named arguments, as they are sent."""


class Engine(Generic[W]):
    """The front's handle of an engine process that holds one worker.

    A call names a method of the worker, as in ``engine.call(EpisodeCalls.seek, "")``. Type checkers compare its
    arguments with the method's, and the process calls the method of that name. The front need not import the worker's
    class; a protocol with its methods suffices.

    Attributes:
        at_once: The number of forks that run at once in the process.
        lost: Whether the process has died.
        talks: Whether a conversation is open.
        asked: Whether a call has no result yet, because its caller was interrupted.
        log: What the process prints.
    """

    def __init__(self, worker: Callable[[list[Connection]], W], slots: int = DEFAULT_SLOTS) -> None:
        """Start the process.

        Args:
            worker: Makes the worker in the new process, from the connections of its forks to the front. It must be
                importable by name.
            slots: The number of forks that run at once.
        """
        self.at_once = slots
        self.lost = self.talks = self.asked = False
        self._owed = 0  # results of posted calls that were not collected yet
        context = multiprocessing.get_context("spawn")
        self._folder = tempfile.TemporaryDirectory(
            prefix=scratch_prefix()
        )  # owned by the front, because the process may be killed
        self.log = EngineLog(Path(self._folder.name))
        note = Path(self._folder.name) / "calls"
        note.write_bytes(bytes(NOTE_BYTES))
        self._watch = Watch(note)
        self._control, control = context.Pipe()
        leash, self._leash = context.Pipe(duplex=False)
        pairs = [context.Pipe() for _ in range(slots)]
        self._slots = [p[0] for p in pairs]
        variables = {**SINGLE_THREAD_VARIABLES, "TMPDIR": self._folder.name}
        with environment(variables), allowed_from_daemons():
            self._process = context.Process(
                target=serve, daemon=True,
                args=(worker, control, [p[1] for p in pairs], (self.log.file, self.log.aside), note, leash),
            )  # fmt: skip
            self._process.start()
        control.close()
        leash.close()
        for _, child_end in pairs:
            child_end.close()

    def call(self, method: Callable[Concatenate[W, P], R], *arguments: P.args, **named: P.kwargs) -> R:
        """Call a method of the worker.

        Args:
            method: The method, named through its class or protocol.
            *arguments: Its positional arguments.
            **named: Its named arguments.

        Returns:
            What the method returns.

        Raises:
            SumoAdvError: The method raised it.
            SimulationError: The process died, or the method raised another error.
            DriverError: The process died in third-party code, or such code did not return in time.
        """
        result: R = self._result((method.__name__, arguments, named), None)
        return result

    def call_answering(
        self, reply: Reply, method: Callable[Concatenate[W, P], R], *arguments: P.args, **named: P.kwargs
    ) -> R:
        """Call a method of the worker, and answer the questions that it or its forks ask meanwhile.

        Args:
            reply: Answers the questions.
            method: The method, named through its class or protocol.
            *arguments: Its positional arguments.
            **named: Its named arguments.

        Returns:
            What the method returns.

        Raises:
            SumoAdvError: As for ``call``.
        """
        result: R = self._result((method.__name__, arguments, named), reply)
        return result

    def _result(self, message: Message, reply: Reply | None) -> Any:
        """Send a call, and wait for its result while answering questions."""
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
        receives None. It asks questions in the other slots.

        Args:
            reply: Answers the questions; None answers each with None.
            method: The method, named through its class or protocol.
            *arguments: Its positional arguments.
            **named: Its named arguments.

        Returns:
            The open conversation.

        Raises:
            SumoAdvError: As for ``call``.
        """
        return Conversation(self, (method.__name__, arguments, named), reply)

    def post(self, method: Callable[Concatenate[W, P], None], *arguments: P.args, **named: P.kwargs) -> None:
        """Call a method without waiting until it returns.

        The next call raises what the method raises. What the process prints from now on belongs to a new episode.

        Args:
            method: The method, named through its class or protocol.
            *arguments: Its positional arguments.
            **named: Its named arguments.

        Raises:
            SimulationError: The process died.
        """
        self.log.begin_episode()
        with self._alive():
            self._order((method.__name__, arguments, named))
        self._owed += 1

    def _order(self, message: Message) -> None:
        """Collect the results of posted calls, then send a call."""
        while self._owed:
            self._owed -= 1
            self._returned()
        self._control.send(message)

    def _returned(self) -> Any:
        """Receive a result, or raise the error that was sent instead."""
        kind, value = self._control.recv()
        if kind == "error":
            raise value
        return value

    @contextmanager
    def _alive(self) -> Iterator[None]:
        """Raise SimulationError if the process dies, or DriverError if it dies in third-party code."""
        try:
            yield
        except (EOFError, BrokenPipeError, ConnectionResetError) as error:
            self.lost = True
            call = self._watch.running()
            if call is not None and not call.is_sumo:
                self._process.join(WATCH_INTERVAL_S)
                raise DriverError(call.ended(exit_in_words(self._process.exitcode))) from error
            raise SimulationError(f"The simulation process ended unexpectedly{self.log.last_words()}.") from error

    def _ready(self, *connections: Connection) -> list[Connection]:
        """Wait until some of the connections can be read, and return those.

        Raises:
            DriverError: Third-party code in the process is overdue; the process is killed.
            SimulationError: SUMO is overdue; the process is killed.
            EOFError: The process has ended, while a process that it left behind holds the connections.
        """
        while not (ready := wait(connections, WATCH_INTERVAL_S)):
            if (call := self._watch.overdue()) is not None:
                self._kill()
                self.lost = True
                raise call.too_late()
            if not self._process.is_alive() and not wait(connections, 0):
                raise EOFError
        return [each for each in ready if isinstance(each, Connection)]

    def close(self) -> None:
        """End the process and remove its files."""
        for connection in (self._control, self._leash, *self._slots):
            connection.close()
        self._process.join(timeout=0.5)
        self._kill()
        self._process.join()
        self._folder.cleanup()

    def _kill(self) -> None:
        """End the process, and the processes that third-party code has left behind in its group."""
        if hasattr(os, "killpg") and self._process.pid is not None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Conversation:
    """A call that stays open until it is told to end.

    Attributes:
        said: The last message from the method.
    """

    def __init__(self, engine: Engine[Any], message: Message, reply: Reply | None) -> None:
        """Begin the call, and wait for the first message.

        Args:
            engine: The engine.
            message: The call.
            reply: Answers the method's questions; None answers each with None.

        Raises:
            SumoAdvError: As for ``Engine.call``.
        """
        self._engine, self._reply, self._over = engine, reply, False
        with engine._alive():
            engine._order(message)
        engine.talks = True
        self.said = self._listen()

    def ask(self, message: Any) -> Any:
        """Send a message, and return the method's answer.

        Args:
            message: The message.

        Returns:
            The answer.

        Raises:
            SumoAdvError: The error that ended the method.
            SimulationError: The process died, or the method has already ended.
        """
        if self._over:
            raise SimulationError("The command has ended, so it answers no more: begin another.")
        with self._engine._alive():
            self._engine._slots[0].send(message)
        self.said = self._listen()
        return self.said

    def _listen(self) -> Any:
        """Wait for the next message of the method while answering questions."""
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
        """Tell the method to end, which frees the engine for other calls. The call may be repeated.

        Raises:
            SumoAdvError: The error that ended the method.
            SimulationError: The process died.
        """
        if self._over:
            return
        self._over, engine = True, self._engine
        with engine._alive():
            engine._slots[0].send(None)
            engine._ready(engine._control)
            engine.talks = False
            while engine._slots[0].poll():  # an answer that was not read because ``ask`` was interrupted
                engine._slots[0].recv()
            engine._returned()
