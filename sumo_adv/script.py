"""Describe a script: what an adversary does, as a short list of actions with conditions in the terms of OpenSCENARIO.

A script is the table ``[[scripts]]`` of a scenario file, or a part of a language model's draft. It is for vehicles, for
pedestrians or for cyclists. It is an intent: its label and its description are made of its actions.
``planners/scripts.py`` compiles it to a planner.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

AppliesTo = Literal[
    "leader",
    "follower",
    "neighbour",
    "oncoming",
    "crossing_left",
    "crossing_straight",
    "crossing_right",
    "merging",
    "cyclist",
    "cyclist_straight",
    "cyclist_hidden",
    "pedestrian",
    "pedestrian_hidden",
]
"""``memory/records.py:RELATIONS``."""
MAX_ACTIONS = 8
MAX_TUNED_NUMBERS = 12  # of a planner (``planners/text.py``)
TUNED_SHARES = (0.6, 1.5)  # a plain number is tuned between these shares of it
USUAL_SPEEDS_M_S = {"pedestrian": 1.4, "cyclist": 4.0}  # of ``walk_to`` without a speed


class Verb(StrEnum):
    """What an action does."""

    SPEED = "speed"
    BRAKE = "brake"
    STOP_FOR = "stop_for"
    LANE_CHANGE = "lane_change"
    LATERAL_OFFSET = "lateral_offset"
    TURN = "turn"
    WAIT = "wait"
    WALK_TO = "walk_to"
    TURN_BACK = "turn_back"


WALKER_VERBS = (Verb.WALK_TO, Verb.WAIT, Verb.TURN_BACK, Verb.SPEED)
"""What a pedestrian or a cyclist can do. ``walk_to`` and ``turn_back`` are for no vehicle."""


class Takes(NamedTuple):
    """The values of a verb.

    Attributes:
        needed: The keys that it needs.
        defaults: The values of the keys that may be left out.
    """

    needed: tuple[str, ...]
    defaults: Mapping[str, float] = {}


TAKES = {
    Verb.SPEED: Takes(("speed",), {"rate": 2.0}),
    Verb.BRAKE: Takes(("rate",), {"speed": 0.0}),
    Verb.STOP_FOR: Takes(("seconds",), {"rate": 3.0}),
    Verb.LANE_CHANGE: Takes(("side",), {"seconds": 4.0}),
    Verb.LATERAL_OFFSET: Takes(("offset",), {"seconds": 3.0}),
    Verb.TURN: Takes(("side",)),
    Verb.WAIT: Takes(("seconds",)),
    Verb.WALK_TO: Takes(("offset",), {"speed": USUAL_SPEEDS_M_S["pedestrian"]}),
    Verb.TURN_BACK: Takes(()),
}
BOUNDS = {
    "speed": (0.0, 60.0), "rate": (0.2, 8.0), "seconds": (0.1, 30.0), "offset": (-3.0, 3.0), "value": (0.0, 300.0),
    "ahead": (-100.0, 300.0), "place": (-20.0, 20.0), "pace": (0.3, 8.0),
}  # fmt: skip
"""The least and the largest value of each number [m, s, m/s, m/s2]; ahead is the value of ``ahead_of_ego``, place and
pace are the offset and the speed of ``walk_to``."""
WALK_BOUNDS = {"offset": "place", "speed": "pace"}


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Tunable(_Table):
    """A number with the range in which the search may change it. low = high keeps it as it is."""

    default: float
    low: float
    high: float

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low <= self.default <= self.high:
            raise ValueError("a number needs low <= default <= high")
        return self


Number = Tunable | float
"""A plain number is tuned around its value; 0 stays 0."""


class Condition(_Table):
    """When an action begins. time: seconds since the attack began. distance_to_ego: m between the two boxes.
    ahead_of_ego: m from the ego's front to its rear; negative while that is behind the front. time_to_meet: seconds
    until the two meet (until the ego is where their ways meet; on one way, the gap by the speed at which it closes).
    after: the last action has ended. rule: whether the number must be below or above the value (time: always above)."""

    kind: Literal["after", "time", "distance_to_ego", "ahead_of_ego", "time_to_meet"]
    value: Number | None = None
    rule: Literal["below", "above"] = "below"

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.value is None) != (self.kind == "after"):
            raise ValueError(f"the condition {self.kind} {'takes no' if self.kind == 'after' else 'needs a'} value")
        if self.value is not None:
            _check_bounds(f"the condition {self.kind}", self.key, tunable(self.key, self.value))
        return self

    @property
    def key(self) -> str:
        """The name of the bounds of its value."""
        return "ahead" if self.kind == "ahead_of_ego" else "value"


class Action(_Table):
    """One action. It begins when its condition holds, or without one when the last action has ended.

    speed: to speed [m/s], with rate [m/s2]. brake: with rate, down to speed (0 if left out). stop_for: brake to a stand
    with rate, and stand for seconds. lane_change: to the next lane on side, within seconds. lateral_offset: to offset m
    left (negative: right) of the middle of its lane, within seconds. turn: left or right at the junction. wait: go on
    as it is for seconds. Pedestrians and cyclists have other actions. walk_to: straight across the EGO's way until
    offset m to the left of its middle (negative: right), with speed (on foot 1.4), and stand there. wait: stop, and
    stand for seconds. turn_back: turn round, and go back at the last speed. speed: from now on (no rate)."""

    verb: Verb
    when: Condition | None = None
    speed: Number | None = None
    rate: Number | None = None
    seconds: Number | None = None
    offset: Number | None = None
    side: Literal["left", "right"] | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        takes = TAKES[self.verb]
        for key in ("speed", "rate", "seconds", "offset", "side"):
            value = getattr(self, key)
            if key in takes.needed and value is None:
                raise ValueError(f"the action {self.verb} needs {key}")
            if value is not None and key not in takes.needed and key not in takes.defaults:
                raise ValueError(f"the action {self.verb} takes no {key}")
            if value is not None and key != "side":
                _check_bounds(f"the action {self.verb}", self.bounds(key), tunable(self.bounds(key), value), key)
        return self

    def bounds(self, key: str) -> str:
        """Return the name of the bounds of a number of the action.

        Args:
            key: The name of the number.
        """
        return WALK_BOUNDS.get(key, key) if self.verb is Verb.WALK_TO else key

    def number(self, key: str) -> Tunable:
        """Return a number of the action, or the default of its verb.

        Args:
            key: The name of the number: speed, rate, seconds or offset.
        """
        value: Number | None = getattr(self, key)
        default = TAKES[self.verb].defaults.get(key, 0.0)
        if value is None:
            return Tunable(default=default, low=default, high=default)
        return tunable(self.bounds(key), value)


class Script(_Table):
    """What an adversary does. applies: the relations to the ego from which it begins. name: of two or three words, for
    its label. actions: in their order."""

    name: str = Field(default="", pattern=r"^([A-Za-z][A-Za-z0-9 '-]{1,39})?$")
    applies: Annotated[tuple[AppliesTo, ...], Field(min_length=1, max_length=4)]
    actions: Annotated[tuple[Action, ...], Field(min_length=1, max_length=MAX_ACTIONS)]

    @model_validator(mode="after")
    def _playable(self) -> Self:
        if len(set(self.applies)) < len(self.applies):
            raise ValueError("a script names each relation once")
        if len({_user_of(relation) for relation in self.applies}) > 1:
            raise ValueError(
                "a script is for vehicles, for pedestrians or for cyclists: it applies to one of them only"
            )
        for verb in (Verb.TURN, Verb.TURN_BACK):
            if sum(action.verb is verb for action in self.actions) > 1:
                raise ValueError(f"a script may have one {verb}")
        for k, action in enumerate(self.actions):
            self._check_verb(f"action {k + 1} ({action.verb})", action)
        count = sum(number.low < number.high for action in self.actions for number in numbers_of(action).values())
        if count > MAX_TUNED_NUMBERS:
            raise ValueError(
                f"a script may have {MAX_TUNED_NUMBERS} numbers to tune, and this one has {count}: leave some out, or "
                "give them low = high"
            )
        return self

    def _check_verb(self, this: str, action: Action) -> None:
        """Raise ValueError if an action is not one of the script's road user."""
        if self.user == "vehicle":
            if action.verb in (Verb.WALK_TO, Verb.TURN_BACK):
                raise ValueError(f"{this} is for pedestrians and cyclists only")
        elif action.verb not in WALKER_VERBS:
            raise ValueError(f"{this} is for vehicles only: a {self.user} has {', '.join(WALKER_VERBS)}")
        elif action.rate is not None:
            raise ValueError(f"{this} of a {self.user} takes no rate")

    @property
    def user(self) -> str:
        """The kind of road user that it is for: vehicle, pedestrian or cyclist (``road_users.RoadUser``)."""
        return _user_of(self.applies[0])

    def pace(self, action: Action) -> float:
        """Return the speed of a ``walk_to`` [m/s], which is the usual one of its road user if it has none.

        Args:
            action: The action.
        """
        return USUAL_SPEEDS_M_S[self.user] if action.speed is None else action.number("speed").default

    @property
    def label(self) -> str:
        """The label of the intent, such as ``Script: brake, speed, brake``, or with its name."""
        actions = ", ".join(" ".join((_plain(a.verb), a.side or "")).strip() for a in self.actions)
        return f"Script: {self.name or actions}"

    @property
    def description(self) -> str:
        """The description of the intent, one sentence."""
        if self.user == "vehicle":
            return f"The vehicle {', then '.join(map(_in_words, self.actions))}."
        words = (_walk_in_words(action, self.pace(action)) for action in self.actions)
        return f"The {self.user} {', then '.join(words)}."


def tunable(key: str, value: Number) -> Tunable:
    """Return a number with its range.

    Args:
        key: The name of the bounds, which hold for the range of a plain number.
        value: The number.
    """
    if isinstance(value, Tunable):
        return value
    least, most = BOUNDS[key]
    low, high = sorted(round(share * value, 3) for share in TUNED_SHARES)
    return Tunable(default=value, low=min(max(low, least), value), high=max(min(high, most), value))


def numbers_of(action: Action) -> dict[str, Tunable]:
    """Return the numbers of an action by name; ``value`` is that of its condition.

    Args:
        action: The action.
    """
    takes = TAKES[action.verb]
    numbers = {key: action.number(key) for key in (*takes.needed, *takes.defaults) if key != "side"}
    if action.when is not None and action.when.value is not None:
        numbers["value"] = tunable(action.when.key, action.when.value)
    return numbers


def _check_bounds(what: str, key: str, number: Tunable, name: str = "") -> None:
    """Raise ValueError if a number is out of its bounds."""
    least, most = BOUNDS[key]
    if number.low < least or number.high > most:
        raise ValueError(f"{what} takes a {name or key} of {least:g} to {most:g}")


def _user_of(relation: AppliesTo) -> str:
    """Return the kind of road user that has a relation."""
    kind = relation.partition("_")[0]
    return kind if kind in USUAL_SPEEDS_M_S else "vehicle"


def _plain(verb: Verb) -> str:
    return verb.replace("_", " ")


def _in_words(action: Action) -> str:
    """Return an action as the end of a sentence that begins with the vehicle."""
    speed, rate, seconds, offset = (action.number(key).default for key in ("speed", "rate", "seconds", "offset"))
    words = {
        Verb.SPEED: f"drives on at {speed:g} m/s",
        Verb.BRAKE: f"brakes with {rate:g} m/s2 {f'to {speed:g} m/s' if speed else 'to a stand'}",
        Verb.STOP_FOR: f"stops for {seconds:g} s",
        Verb.LANE_CHANGE: f"changes to the next lane on the {action.side}",
        Verb.LATERAL_OFFSET: f"moves {abs(offset):g} m to the {'left' if offset > 0 else 'right'} in its lane",
        Verb.TURN: f"turns {action.side}",
        Verb.WAIT: f"goes on for {seconds:g} s",
    }[action.verb]
    return " ".join((words, *_condition_in_words(action.when)))


def _walk_in_words(action: Action, pace: float) -> str:
    """Return an action of a pedestrian or cyclist as the end of a sentence that begins with it."""
    speed, seconds, offset = (action.number(key).default for key in ("speed", "seconds", "offset"))
    there = f"to {abs(offset):g} m {'left' if offset > 0 else 'right'} of" if offset else "into"
    words = {
        Verb.WALK_TO: f"goes {there} the middle of the ego's way at {pace:g} m/s",
        Verb.WAIT: f"stands for {seconds:g} s",
        Verb.TURN_BACK: "turns round and goes back",
        Verb.SPEED: f"goes on at {speed:g} m/s",
    }[action.verb]
    return " ".join((words, *_condition_in_words(action.when)))


def _condition_in_words(when: Condition | None) -> Iterator[str]:
    """Yield a condition in words; nothing if the last action must have ended."""
    if when is None or when.value is None:
        return
    value, below = tunable(when.key, when.value).default, when.rule == "below"
    if when.kind == "time":
        yield f"{value:g} s after the beginning"
    elif when.kind == "ahead_of_ego":
        yield f"when it is {'less' if below else 'more'} than {value:g} m ahead of the ego"
    elif when.kind == "distance_to_ego":
        yield f"when the ego is {'nearer' if below else 'farther'} than {value:g} m"
    else:
        yield f"when they meet within {value:g} s" if below else f"while they do not meet within {value:g} s"
