"""What the ego's client has subscribed to: it ends with the client, and before an object that it removes."""

from __future__ import annotations

from sumo_adv.serve import framing, shapes
from sumo_adv.serve.framing import Command, make_command, make_message
from sumo_adv.serve.link import Link
from sumo_adv.serve.policy import CONTEXTS, GETTER_TO_SUBSCRIPTION, SETTERS

LONGEST_COMPLAINT = 200  # bytes of an error that SUMO survives in any case
_SUBSCRIPTION = {name: number + 0x10 for number, name in SETTERS.items()}
_CONTEXT = {name: number - 0x40 for number, name in SETTERS.items()}


class Subscriptions:
    """Of one simulation. Every method that speaks with SUMO may raise SumoGone."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._kept: dict[tuple[int, bytes, bytes], Command] = {}  # by number, domain of a context, name of the object

    def note(self, command: Command) -> None:
        """SUMO accepted a subscription, or the end of one."""
        end = shapes.name_end(command.payload, 16)
        context = command.number in CONTEXTS
        domain = command.payload[end : end + 1] if context else b""
        key = command.number, domain, command.payload[20:end]
        if command.payload[end + (9 if context else 0)]:
            self._kept[key] = command
        else:
            self._kept.pop(key, None)

    def end(self) -> None:
        """End all of them."""
        for command in list(self._kept.values()):
            self._link.unsubscribe(command)
        self._kept.clear()

    def end_of(self, domain: str, name: bytes) -> None:
        """End those of an object that is about to be removed: SUMO fails in every step after that otherwise."""
        numbers = _SUBSCRIPTION[domain], _CONTEXT[domain]
        for key in [key for key in self._kept if key[0] in numbers and key[2] == name]:
            self._link.unsubscribe(self._kept.pop(key))

    def deadly(self, command: Command) -> str:
        """What SUMO would complain of, if it would be too long for it: it puts a sentence a variable into one error."""
        end = shapes.name_end(command.payload, 16)
        getter = command.number - GETTER_TO_SUBSCRIPTION
        variables = shapes.subscribed(command.payload, end, getter)
        if len(variables) < 2:
            return ""
        name = command.payload[16:end]
        questions = (make_command(getter, variable[:1] + name + variable[1:]) for variable in variables)
        complaints = [framing.complaint(self._link.ask(make_message(question))) for question in questions]
        whole = f"Could not add subscription. {' '.join(complaints).strip()}"
        return whole if len(whole.encode()) > LONGEST_COMPLAINT else ""
