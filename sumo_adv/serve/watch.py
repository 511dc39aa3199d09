"""Waits for an encounter in a session, and says whether what was decided about one still holds."""

from __future__ import annotations

from collections.abc import Mapping

from sumo_adv.config import Settings
from sumo_adv.datatypes import Track
from sumo_adv.episode.encounter_detector import LOOK_EVERY, EncounterDetector, RankedVehicle
from sumo_adv.episode.traffic_forecast import apart
from sumo_adv.serve.session import EgoLost, Session
from sumo_adv.simulation.network import RoadMap

STRAYED = 4.0, 2.5  # m, m/s from where ego or BV was foreseen to be: the scene is another one
EGO_PAUSE = 2.0  # s the ego is on the road before anything may happen to it


class EncounterMonitor:
    """Looks at one session every half second."""

    def __init__(self, session: Session, road: RoadMap, settings: Settings, only: tuple[str, ...], warm_up: float):
        self._session, self._road, self._settings, self._only = session, road, settings, only
        self._since = max(settings.history, EGO_PAUSE, warm_up)
        self._encounter = self._fresh()

    def until_encounter(self, end: float, *, trigger: float | None = None, quiet: float = 0.0) -> list[RankedVehicle]:
        """Step until one begins: possible adversaries, most dangerous first; empty at ``end`` [s] or without traffic.

        ``trigger``: attack from this time on whatever the risk; ``quiet``: s from now on in which none may begin.

        Raises:
            ClientGone: the client did not come back in time.
        """
        session, every = self._session, self._settings.steps(LOOK_EVERY)
        from_here = session.now + quiet
        self._encounter = self._fresh()
        while session.now < end:
            session.hold()
            session.tick()
            ready = session.now >= from_here and session.ready(self._since)
            if not ready:
                self._encounter = self._fresh()
            elif trigger is not None:
                if session.now >= trigger - 1e-6:
                    return self._encounter.rank(session)
            elif session.steps % every == 0 and (ranking := self._encounter.look(session)):
                return ranking
            if session.steps % every == 0 and session.deserted():
                break
        return []

    def until(self, time: float) -> bool:
        """Step until ``time`` [s]; True if the ego is there then and its client drives it.

        Raises:
            ClientGone: the client did not come (back) in time.
        """
        session = self._session
        while session.now < time - 1e-6:
            session.hold()
            try:
                session.tick()
            except EgoLost:
                return False
        return session.ready(0.0)

    def changed(self, tracks: Mapping[str, Track], bv: str, relation: str) -> str:
        """Why the scene differs from the predicted one; empty if it does not."""
        session = self._session
        raw = session.snapshot.raw
        assert session.ego is not None
        for name in (session.ego, bv):
            if name not in raw:
                return f"{name} is gone"
            away, faster = apart(tracks, session.state(name), session.now)
            if away > STRAYED[0] or faster > STRAYED[1]:
                return f"{name} is {away:.1f} m and {faster:.1f} m/s from where it was foreseen"
        present = {c.id: c.relation for c in EncounterDetector(self._road, len(raw), (bv,)).rank(session)}
        return (
            "" if present.get(bv) == relation else f"{bv} is no longer {relation} but {present.get(bv, 'out of reach')}"
        )

    def _fresh(self) -> EncounterDetector:
        settings = self._settings
        return EncounterDetector(self._road, settings.shortlist, self._only, settings.kind, odd=settings.odd)
