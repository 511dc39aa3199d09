"""What the paper reports, and why its figures are not the same quantities as ours.

Mei, Nie, Sun and Tian, "Seeking to Collide: Online Safety-Critical Scenario Generation for Autonomous Driving with
Retrieval Augmented Large Language Models". Its only table is Table I.
"""

from __future__ import annotations

from dataclasses import dataclass

from sumo_adv.benchmark.tables.cells import RAW


@dataclass(frozen=True, slots=True)
class Reported:
    """A row of the paper's Table I: mean min TTC [s], collision rate, over its 81 scenarios."""

    row: str
    mean_min_ttc: float
    collision: float


TABLE_I = (
    Reported("Raw", 1.62, 0.00),
    Reported("Transformer", 1.73, 0.41),
    Reported("LLM-F (V3)", 2.03, 0.22),
    Reported("LLM-A (V3)", 1.09, 0.65),
    Reported("LLM-A (R1)", 1.08, 0.75),
)
ACCURACY = {"DeepSeek-R1": 0.815, "DeepSeek-V3": 0.741}  # Fig. 3 and section IV-B, against people's labels
DIVERGENCES = {"speed_kl": 0.141, "acceleration_kl": 0.138}  # section IV-C, Fig. 5
ABNORMAL_LATERAL = 0.0017  # share with a lateral acceleration above 4 m/s2, section IV-C
SCENARIOS = {"straight": 50, "intersection": 31}  # section IV-A, of the Waymo Open Motion Dataset

COLLISION_NOTE = (
    "The paper calls it a collision when the centres come within an epsilon that it does not give; ours is a touch of "
    "the boxes, and the column 'collision rate (paper)' takes 5 m. The paper does not say which driver its ego is, "
    "whether an adversary's motion had to be feasible, nor whether running into the ego's back counts."
)
TTC_NOTE = (
    "The paper does not define its TTC nor say how collisions and encounters that never close in are averaged: with "
    "75 % collisions at 0 s, a mean of 1.08 s would be 4.3 s over the rest. Ours is of oriented boxes in the plane, a "
    "collision is 0 s and never is 10 s. Its encounters are 81 Waymo records with a raw mean min TTC of 1.62 s and no "
    "raw collision; in suite81 no encounter is critical before the attack."
)
REALISM_NOTE = (
    "The paper gives neither bins nor smoothing nor which samples it pools; ours are 1 m/s and 0.5 m/s2 wide with 0.1 "
    "added to each, the adversaries' steps up to contact against unattacked vehicles near in the same window."
)
ANALYZER_NOTE = (
    "The paper's labels are its authors' own annotations of one given vehicle in each of 81 records; an oracle's label "
    "is what collides most in simulation against one ego, with ties as sets, and the analyzer picks the vehicle too."
)


def counterpart(row: str) -> str | None:
    """The paper's row that a row of ours stands for; None for opponents and changed rows, which the paper has not.

    LLM-A stands beside its better figure, R1's, but for DeepSeek-V3 itself.
    """
    name = row.lower()
    if "+" in name:
        return None
    if name == RAW:
        return "Raw"
    if name == "transformer":
        return "Transformer"
    if name.startswith("llm-f"):
        return "LLM-F (V3)"
    if name == "expert" or name.startswith("llm-a"):
        return "LLM-A (V3)" if "v3" in name or "deepseek-chat" in name else "LLM-A (R1)"
    return None
