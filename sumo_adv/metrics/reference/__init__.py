"""Reference drivers: the drivers that a collision is judged against, each with its rule and its source.

A reference driver drives the ego in the counterfactual. It is causal: in each step, it sees only what has happened so
far. Until its rule says that a danger shows, the ego moves as it was recorded. From then on, the driver brakes on the
ego's path; ``manoeuvre`` also steers.

=========== ============================================================================ ===================
name        rule                                                                         judges
=========== ============================================================================ ===================
cc_human    UN R157's careful and competent human driver (``cc_human.py``)               every encounter
manoeuvre   braking and steering within a friction circle (``avoidance.py``)             every encounter
reg157      UN R157's requirement for cut-ins, 5.2.5.2 (``brakers.py``)                  same direction
rss         Responsibility-Sensitive Safety (``brakers.py``)                             same direction
fsm         JRC's Fuzzy Safety Model (``brakers.py``)                                    same direction
=========== ============================================================================ ===================

The drivers for the same direction have rules for vehicles, including cyclists, but none for pedestrians.
"""

from __future__ import annotations

from sumo_adv.metrics.reference.brakers import Braker, Fsm, Reg157, RssDriver
from sumo_adv.metrics.reference.cc_human import CcHuman

BRAKERS: dict[str, type[Braker]] = {"cc_human": CcHuman, "reg157": Reg157, "rss": RssDriver, "fsm": Fsm}
"""Reference drivers that brake and do not steer."""
MANOEUVRE = "manoeuvre"
REFERENCE_DRIVERS = ("cc_human", MANOEUVRE, "reg157", "rss", "fsm")
SAME_DIRECTION_ONLY = ("reg157", "rss", "fsm")
COMPETENT = ("cc_human", MANOEUVRE, "reg157")
"""A *valid* collision must be avoided by one of these reference drivers. ``rss`` and ``fsm`` are left out: they brake
without need 12.3 and 3.6 times in 10 km of ordinary traffic (``benchmarks/false_alarms.py``), so a collision that only
they avoid says nothing about the ego.
"""

__all__ = ["BRAKERS", "COMPETENT", "MANOEUVRE", "REFERENCE_DRIVERS", "SAME_DIRECTION_ONLY", "Braker"]
