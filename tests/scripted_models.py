"""What a language model could have answered: scripts for ``model_server`` that read the question they get."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from model_server import Asked

APPLIES = re.compile(r"^(BV\d+): .*Behaviours that apply: (.*)\.$", re.MULTILINE)


def agent_of(request: Asked) -> str:
    """The agent that asked a question."""
    opening = request.system[:60]
    for agent, word in (("generator", "You write"), ("modifier", "You repair"), ("confirm", "You compare")):
        if opening.startswith(word):
            return agent
    return "analyzer"


def chosen(request: Asked, label: str) -> str:
    """The first BV that the behaviour applies to, else the first BV."""
    question = next(content for role, content in request.messages if role == "user")
    listed = APPLIES.findall(question)
    return next((bv for bv, labels in listed if label in labels.split(", ")), listed[0][0])


def intent(bv: str, label: str, acceleration: Any = 0.0, risk: str = "high", description: str = "") -> dict[str, Any]:
    """One ranked intent."""
    return {
        "bv": bv, "label": label, "novel": bool(description), "description": description, "risk": risk,
        "acceleration": acceleration, "reason": "It reaches the ego late and from the side.",
    }  # fmt: skip


@dataclass
class Author:
    """Answers as a model that wants one behaviour. Planners it writes and rewrites come from ``texts`` in order; where
    there are ``edits`` instead, a planner to be changed gets the first (old, new) replacement that fits it.
    ``ways``: how to carry the behaviour out."""

    label: str
    acceleration: Any = 0.0
    description: str = ""
    texts: Sequence[str] = ()
    edits: Sequence[tuple[str, str]] = ()
    ways: Sequence[Mapping[str, Any]] = ()
    questions: list[str] = field(default_factory=list)

    def __call__(self, request: Asked) -> Mapping[str, Any]:
        agent = agent_of(request)
        self.questions.append(agent)
        if agent == "analyzer":
            first_intent = intent(
                chosen(request, self.label), self.label, self.acceleration, description=self.description
            )
            return {"analysis": "As told.", "intents": [first_intent | {"ways": list(self.ways)}]}
        if agent == "confirm":
            return {"same_as": None, "reason": "It is another manoeuvre."}
        written = sum(q in ("generator", "modifier") for q in self.questions) - 1
        text = self._edited(request, written) if self.edits else self.texts[min(written, len(self.texts) - 1)]
        return {"mode": "direct", "diagnosis": "As told.", "source": text}

    def _edited(self, request: Asked, written: int) -> str:
        matched = re.search(r"PLANNER \(mode .*?\)\n(.*)\n\nWHAT ITS ATTEMPTS SHOWED", request.last, re.DOTALL)
        assert matched is not None
        text = matched.group(1)
        fitting = [(old, new) for old, new in self.edits if old in text]
        return text.replace(*fitting[0]) if fitting else f"{text}# rewritten {written}\n"


def answered(outcome: Mapping[str, Any]) -> str:
    """An outcome's attempts in a line each, for messages of failing tests."""
    return json.dumps(
        [
            {k: a[k] for k in ("by", "phase", "intent", "min_ttc", "failed_gates", "message")}
            for a in outcome["attempts"]
        ],
        indent=1,
    )
