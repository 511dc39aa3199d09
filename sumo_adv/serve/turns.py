"""The ego's turns in one simulation: the client's requests are checked and passed on, and there is always a step."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable

from sumo_adv.serve import framing
from sumo_adv.serve.framing import (
    FramingError,
    Gone,
    MessageLine,
    TraciCommand,
    make_command,
    make_message,
    make_status,
)
from sumo_adv.serve.link import OlderClients, Subscriptions, SumoGone, SumoLink
from sumo_adv.serve.policy import CONTEXTS, GETTERS, MAX_STEP_S, SETTERS, SUBSCRIPTIONS, Policy, removed, step_until
from sumo_adv.serve.seat import Client, ClientSlot, EventKind, GateEvent, Interrupted, Late, Stepper, errors
from sumo_adv.serve.shapes import Misfit

MAX_UNHEARD_ANSWERS = 1000  # maximum number of answers without SUMO outside a client's turn; then it waits for its turn
_EMPTY_STEP = make_message(make_status(framing.SIMSTEP), bytes(4))
_WITHOUT_SUMO = {framing.GETVERSION, framing.SETORDER, framing.CLOSE}
_RESTARTED = "The simulation was restarted: ask again."


class Turns:
    """One simulation, from attach to its end. Call ``run`` in one thread; everything else may be used from any thread.

    Attributes:
        policy: What the client may do.
        stepped_by: What made the last step on the ego's side.
        client_steps: The number of steps that the client made.
    """

    def __init__(
        self, connect: Callable[[Callable[[], None]], SumoLink], policy: Policy, seat: ClientSlot, deadline: float,
        stopping: Callable[[], bool], why_ended: Callable[[], str], older: bool = False,
    ) -> None:  # fmt: skip
        """Connect to SUMO.

        Args:
            connect: Makes the link to SUMO; takes a function to call while waiting for SUMO.
            policy: What the client may do.
            seat: The seat of the client.
            deadline: The time of the client for one turn [s].
            stopping: Tells that the server stops.
            why_ended: Returns SUMO's last error once it has ended.
            older: Whether clients know TraCI only up to version 21 (``OlderClients``).
        """
        self.policy = policy
        self.stepped_by = Stepper.GATE
        self.client_steps = 0
        self._seat, self._deadline, self._stopping, self._why_ended = seat, deadline, stopping, why_ended
        self._parting = self._keep = False
        self._served: Client | None = None
        self._translates = OlderClients() if older else None
        self._our_turn = False
        self._unheard = 0  # number of answers in a row that did not need SUMO
        self._turn_began = 0.0  # by the monotonic clock [s]
        self._link = connect(self._while_sumo_works)
        self._subscriptions = Subscriptions(self._link)

    def part(self, keep: bool) -> None:
        """Close the connection to SUMO after the current request.

        Args:
            keep: Whether the client stays for the next simulation.
        """
        self._keep = keep
        self._parting = True

    def run(self) -> None:
        """Serve turns until ``part`` is called or SUMO ends."""
        try:
            self._link.greet()
            while not self._interrupted():
                self._next()
            self._send_client_away()
            self._link.leave()
        except SumoGone:
            self._send_client_away()
        except Interrupted:
            pass
        finally:
            self._link.close()

    def _interrupted(self) -> bool:
        """Return whether the turns end."""
        return self._parting or self._stopping()

    def _next(self) -> None:
        """Serve the client's next message, or stand in for an absent client."""
        client = self._seat.client
        if client is not self._served:
            self._subscriptions.end()
            self._served, self._turn_began = client, time.monotonic()
        if client is None:
            self._stand_in()
        else:
            self._guarded(client, self._converse)

    def _converse(self, client: Client) -> None:
        """Receive a message, and answer it."""
        message = self._listen(client)
        commands = framing.split(message)
        try:
            answer = self._answer_all(client, commands)
        except Late:
            client.line.unread(message)
            raise
        client.send(answer, self._time_left())
        if commands[-1].number == framing.CLOSE:
            self._seat.leave(client, EventKind.CLOSED, f"The client at {client.peer} closed the connection.")

    def _guarded(self, client: Client, talk: Callable[[Client], None]) -> None:
        """Talk with a client; if that fails, the client loses its seat."""
        try:
            talk(client)
        except Interrupted:
            return
        except Late:
            self._seat.leave(
                client, EventKind.LATE,
                f"The client at {client.peer} took more than {self._deadline:g} s for a turn; "
                "the simulation went on without it.",
            )  # fmt: skip
        except (Gone, FramingError) as reason:
            self._seat.leave(client, EventKind.LOST, f"The client at {client.peer} was lost: {reason}.")

    def _stand_in(self) -> None:
        """Wait for the gate's turn, and step unless a client has come meanwhile."""
        self._await_turn()
        if self._seat.client is None and not self._interrupted():
            self.stepped_by = Stepper.GATE
            self._link.step()
            self._our_turn = False

    def _await_turn(self) -> None:
        """Wait for the gate's turn; meanwhile answer what needs no SUMO."""
        if self._our_turn:
            return
        waiting: Client | None = None  # a client whose request must wait for SUMO

        def listen() -> MessageLine | None:
            client = self._seat.client
            return client.line if client is not None and client is not waiting else None

        def talk() -> None:
            nonlocal waiting
            client = self._seat.client
            if client is not None and not self._small_talk(client):
                waiting = client

        self._link.await_turn(listen, talk)
        self._begin_turn()

    def _begin_turn(self) -> None:
        """Begin the gate's turn: from now on SUMO waits, and the client's clock runs."""
        if not self._our_turn:
            self._our_turn, self._turn_began = True, time.monotonic()

    def _small_talk(self, client: Client) -> bool:
        """Answer a message whose commands need no SUMO; return False, and leave the message unread, if one does."""
        done = False

        def talk(client: Client) -> None:
            nonlocal done
            try:
                message = client.receive(framing.POLL_PERIOD_S, self._interrupted)
            except Late:
                return  # half a message; the clock of its turn decides
            done = all(command.number in _WITHOUT_SUMO for command in framing.split(message))
            client.line.unread(message)
            if done:
                self._converse(client)

        self._guarded(client, talk)
        return done

    def _listen(self, client: Client) -> bytes:
        """Return the client's next message, unless its time is up."""
        message = client.line.receive(self._while_client_thinks)
        if self._is_late():
            client.line.unread(message)
            raise Late
        return message

    def _while_client_thinks(self) -> None:
        """Watch the clock, and for the end of the turns, while the client sends nothing."""
        if self._interrupted():
            raise Interrupted
        self._await_turn()
        if self._is_late():
            raise Late

    def _is_late(self) -> bool:
        """Return whether the client's time is up."""
        return self._our_turn and self._time_left() <= 0.0

    def _time_left(self) -> float:
        """Return the client's remaining time in this turn [s]; all of it before the turn begins."""
        return self._deadline - (time.monotonic() - self._turn_began if self._our_turn else 0.0)

    def _answer_all(self, client: Client, commands: list[TraciCommand]) -> bytes:
        """Return the answers to the commands of a message."""
        answers: list[bytes] = []
        try:
            for command in commands:
                if self._parting and answers:
                    answers.append(_stand_in_answer(command))
                    continue
                answers.append(self._translated(client, command))
                if self._is_late():
                    raise Late
        except SumoGone:
            if self._parting and self._keep:
                answers += [_stand_in_answer(command) for command in commands[len(answers) :]]
                client.send(_joined(answers), self._deadline)
            raise
        return answers[0] if len(answers) == 1 else _joined(answers)

    def _translated(self, client: Client, command: TraciCommand) -> bytes:
        """Return the answer to a command in the version of TraCI that clients are told."""
        if self._translates is None:
            return self._answer(client, command)
        answer = self._answer(client, self._translates.asked(command))
        if command.number == framing.GETVERSION:
            return self._translates.version(answer)
        return self._translates.answered(command.number, answer)

    def _answer(self, client: Client, command: TraciCommand) -> bytes:
        """Return the answer to a command."""
        number = command.number
        self._count()
        if number == framing.SIMSTEP:
            return self._step(client, command)
        if number == framing.GETVERSION:
            return self._link.version
        if number in (framing.SETORDER, framing.CLOSE):
            return make_message(make_status(number))
        reason = self.policy.refusal(command)
        if reason is not None:
            return self._refuse(client, command, reason)
        if number in GETTERS:
            return self._asked(command)
        if number in SUBSCRIPTIONS and (reason := self._subscriptions.deadly(command)):
            return make_message(make_status(number, framing.STATUS_ERROR, reason))
        if gone := removed(command):
            self._subscriptions.end_of(*gone)
        answer = self._asked(command)
        if framing.accepted(answer):
            if number in SETTERS:
                self.policy.took(command)
            elif number in SUBSCRIPTIONS or number in CONTEXTS:
                self._subscriptions.note(command)
        return answer

    def _asked(self, command: TraciCommand) -> bytes:
        """Return SUMO's answer to a command; after that it is the client's turn."""
        answer = self._link.ask(make_message(command.raw))
        self._begin_turn()
        return answer

    def _count(self) -> None:
        """Count answers without SUMO, and wait for the turn after too many.

        Otherwise a client whose requests need no SUMO, or are all refused, would never use up its time.
        """
        self._unheard = 0 if self._our_turn else self._unheard + 1
        if self._unheard > MAX_UNHEARD_ANSWERS:
            self._link.now()
            self._begin_turn()

    def _refuse(self, client: Client, command: TraciCommand, reason: str) -> bytes:
        """Return the refusal of a command; report it the first time."""
        key = (command.number, command.payload[:64])
        if key not in client.refused and len(client.refused) < 1000:
            client.refused.add(key)
            sentence = f"A call of the client at {client.peer} was refused: {reason}"
            self._seat.tell(GateEvent(EventKind.REFUSED, sentence))
        return make_message(make_status(command.number, framing.STATUS_ERROR, reason))

    def _step(self, client: Client, command: TraciCommand) -> bytes:
        """Pass a step on; replace a past time by the present, as otherwise SUMO would repeat every step since then."""
        try:
            until = step_until(command.payload)
        except Misfit:
            return self._refuse(client, command, "A step needs a time in seconds.")
        count = 1
        if until:
            present = self._link.now()
            self._begin_turn()
            if until > present + MAX_STEP_S:
                return self._refuse(client, command, f"A step cannot be longer than {MAX_STEP_S:g} s.")
            if until <= present:
                return self._link.ask(make_message(make_command(framing.SIMSTEP, struct.pack("!d", present))))
            count = max(1, math.ceil((until - present) / self._link.step_length() - 1e-6))
        return self._steps(client, count)

    def _steps(self, client: Client, count: int) -> bytes:
        """Step one at a time, and only while the client is connected.

        Otherwise a client that requested an hour and left would still drive.

        Raises:
            Gone: The client is no longer connected.
        """
        answer = _EMPTY_STEP
        for k in range(count):
            if k and self._interrupted():
                break
            if client.line.cut:
                raise Gone("it closed the connection")
            self.stepped_by = Stepper.CLIENT
            answer = self._link.step()
            self.client_steps += 1
            self._our_turn = False
        return answer

    def _while_sumo_works(self) -> None:
        """Notice a lost client while SUMO works."""
        if self._stopping():
            raise Interrupted
        client = self._seat.client
        if client is not None and client.line.cut:
            self._seat.leave(client, EventKind.LOST, f"The client at {client.peer} was lost: it closed the connection.")

    def _send_client_away(self) -> None:
        """Report the end of the simulation, and end the client's connection unless it stays."""
        client, parting = self._seat.client, self._parting
        kind = EventKind.RESTARTED if parting else EventKind.ENDED
        reason = "The simulation ended"
        if not parting:
            reason = f"SUMO ended by itself ({self._why_ended() or 'it says nothing'})"
        if client is None or (parting and self._keep):
            self._seat.tell(GateEvent(kind, f"{reason}."))
            return
        self._seat.leave(client, kind, f"{reason}; the client at {client.peer} may connect again.")


def _joined(answers: list[bytes]) -> bytes:
    """Join answers into one message."""
    return make_message(*(answer[4:] for answer in answers))


def _stand_in_answer(command: TraciCommand) -> bytes:
    """Return the answer to a client that stays while SUMO ends in the middle of its request."""
    if command.number == framing.SIMSTEP:
        return _EMPTY_STEP
    return errors(make_message(command.raw), _RESTARTED)
