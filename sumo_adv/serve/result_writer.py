"""Writes the folders of encounters in a thread of its own, so that no simulation waits for a picture."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any

from sumo_adv.episode.episode import Episode
from sumo_adv.errors import SumoAdvError, fault_sentence
from sumo_adv.serve.events import Events

WAITING = 2  # encounters that may wait to be written; then the simulation waits

Write = Callable[[Episode, int], Mapping[str, Any]]


class ResultWriter:
    """``write`` gets an episode and its number and gives back what ``outcome.json`` holds, with its ``folder``."""

    def __init__(self, write: Write, events: Events) -> None:
        self._write, self._events = write, events
        self.critical = self.collided = self.written = 0
        self.failure: SumoAdvError | None = None
        self._tray: queue.Queue[tuple[Episode, int] | None] = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._work, name="result writer", daemon=True)
        self._thread.start()

    def keep(self, episode: Episode, number: int) -> None:
        """Have an encounter written. Raises SumoAdvError if an earlier one could not be."""
        if self.failure is not None:
            raise self.failure
        self._tray.put((episode, number))

    def close(self) -> None:
        """Wait until all is written."""
        if self._thread.is_alive():
            self._tray.put(None)
            self._thread.join()

    def _work(self) -> None:
        while (item := self._tray.get()) is not None:
            if self.failure is None:
                self._write_one(*item)
            del item  # nothing of it is kept while the next one is waited for

    def _write_one(self, episode: Episode, number: int) -> None:
        try:
            result = self._write(episode, number)
        except SumoAdvError as error:
            self.failure = error
        except Exception as error:  # a fault of ours: the run ends with a sentence
            self.failure = SumoAdvError(f"Encounter {number} could not be written. {fault_sentence(error)}")
        else:
            self._report(result, number)

    def _report(self, result: Mapping[str, Any], number: int) -> None:
        best, supports = result["outcome"] or {}, result["adversaries"][1:]
        critical = result["ending"] == "critical"
        self.written += 1
        self.critical += critical
        self.collided += bool(best.get("collided"))
        self._events.tell(
            "outcome", number=number, ending=result["ending"], reason=result["reason"], critical=critical,
            collided=bool(best.get("collided")), valid=best.get("valid"), min_ttc=best.get("min_ttc"),
            adversary=next((a["id"] for a in result["adversaries"]), None),
            intent=(result["intent"] or {}).get("label"), attempts=len(result["attempts"]),
            folder=str(result["folder"]), **({"supports": supports} if supports else {}),
        )  # fmt: skip
