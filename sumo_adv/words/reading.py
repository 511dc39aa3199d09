"""The part of the fit that a language model plays: it is given the motion and the request, and says what happened."""

from __future__ import annotations

from pydantic import BaseModel, Field

from sumo_adv.agents.prompts import Prompts, fenced
from sumo_adv.llm.asking import MeteredModel, ask


class Reading(BaseModel):
    """What a reader makes of a motion."""

    happened: str = Field(max_length=1000)
    fits: bool
    lacks: str = Field(default="", max_length=600)


def read_motion(metered: MeteredModel, prompts: Prompts, motion: str, request: str) -> Reading:
    """A model's reading of a motion in words. It sees neither the plan nor the verdict. Raises ModelError."""
    prompt = prompts.render("reading", motion=motion, request=fenced(request))
    return ask(metered, "reader", prompt.system, prompt.user, Reading)
