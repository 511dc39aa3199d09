"""SUMO's IDM as a user's driver. (In a module of its own: other processes import it by its name.)"""

from __future__ import annotations

from sumo_adv.drivers import Action, Observation


class Idm:
    """SUMO's IDM, of which the search is told nothing."""

    name = "idm as unknown"
    forkable = True
    needs_observation = False

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Action:
        """SUMO drives."""
        return None
