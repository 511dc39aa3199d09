"""A language model with answers that a test gives."""

from __future__ import annotations

from pydantic import BaseModel

from sumo_adv.llm.chat import ChatReply, ChatRequest


class Answers:
    """A model that gives these answers in turn."""

    name = "answers"

    def __init__(self, *answers: BaseModel) -> None:
        self._answers = list(answers)
        self.asked: list[ChatRequest] = []

    def complete(self, request: ChatRequest) -> ChatReply:
        self.asked.append(request)
        return ChatReply(self._answers.pop(0).model_dump_json())
