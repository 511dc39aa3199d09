"""How well a hunt's estimate of what is left holds: at a share of finished hunts, against what the rest of them found.

    python benchmarks/stop_estimate.py runs/hunt-1 runs/hunt-2 ... [--share 0.25] [--json]

Each hunt is cut after a share of its encounters (a quarter). The estimates from these are compared with the whole hunt:

interval   low and high of Chao1 at the cut; it holds if the number of kinds at the end lies in it. The end of a hunt is
           no proof that nothing was left, so below ``low`` only says that the hunt was too short to tell
chance     Good-Turing at the cut, against the share of the next encounters (as many as before the cut) that brought a
           kind that was new then. Encounters later than that are others: the search has moved on

A long hunt has some hundred encounters. Exit status 2: a folder holds no hunt, or too short a one.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Collection, Hashable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from sumo_adv.errors import SumoAdvError
from sumo_adv.hunting.rounds import kinds_by_encounter
from sumo_adv.metrics.species import discovery

FEWEST = 8  # encounters: of fewer a quarter is one or none


@dataclass(frozen=True, slots=True)
class Checked:
    """One hunt. at: encounters before the cut; kinds: distinct failures in them; end: in all. held: within, above
    (more were found than the interval has) or below. chance, came: foretold and seen."""

    hunt: str
    encounters: int
    at: int
    kinds: int
    least: float
    low: float
    high: float
    end: int
    held: str
    chance: float
    came: float


def check(name: str, samples: Sequence[Collection[Hashable]], share: float) -> Checked:
    """Compare the estimates at a share of the samples with all of them."""
    at = max(round(share * len(samples)), 1)
    before = discovery(samples[:at])
    end = discovery(samples).kinds
    held = "within" if before.low <= end <= before.high else "above" if end > before.high else "below"
    known = {kind for sample in samples[:at] for kind in sample}
    following = samples[at : 2 * at]
    came = sum(not known.issuperset(sample) for sample in following) / len(following)
    return Checked(
        name, len(samples), at, before.kinds, before.least, before.low, before.high, end, held, before.chance, came
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hunts", nargs="*", type=Path, help="folders of finished hunts")
    parser.add_argument("--share", type=float, default=0.25, help="of the encounters before the cut (default: 0.25)")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    given = parser.parse_args()
    if not 0.0 < given.share <= 0.5:
        parser.error("--share must be above 0 and at most 0.5")
    checked = []
    if not given.hunts:
        print("no folder of a finished hunt given: nothing to do")
        return 0
    for hunt in given.hunts:
        try:
            samples = kinds_by_encounter(hunt)
        except SumoAdvError as error:
            print(error, file=sys.stderr)
            return 2
        if len(samples) < FEWEST:
            print(f"{hunt} holds {len(samples)} encounters of a hunt; {FEWEST} are needed.", file=sys.stderr)
            return 2
        checked.append(check(hunt.name, samples, given.share))
    within = sum(each.held == "within" for each in checked)
    if given.json:
        print(json.dumps({"share": given.share, "within": within, "hunts": [asdict(each) for each in checked]}))
        return 0
    print(f"{'hunt':24} encounters  cut  kinds  least   95 % interval  at the end  held     chance   came")
    for c in checked:
        interval = f"{c.low:.0f} to {c.high:.0f}"
        print(
            f"{c.hunt[:24]:24} {c.encounters:10}  {c.at:3}  {c.kinds:5}  {c.least:5.1f}  {interval:>14}  {c.end:10}  "
            f"{c.held:7}  {c.chance:5.0%}  {c.came:5.0%}"
        )
    print(f"The interval held in {within} of {len(checked)} hunts.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
