"""The ego that somebody else drives: a client of the same SUMO, over TraCI (``serve``)."""

from __future__ import annotations

from collections.abc import Mapping

from sumo_adv.drivers.protocol import Action, Observation


class ExternalEgo:
    """Does nothing, and so never fights who drives. The vehicle's type stays as the demand gives it."""

    name = "external"
    forkable = False
    needs_observation = False
    sumo_type: Mapping[str, str] = {}

    def reset(self, seed: int) -> None:
        """Nothing of it is here."""

    def act(self, observation: Observation) -> Action:
        """Never called."""
        return None
