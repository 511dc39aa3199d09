"""Choose the inputs of a hunt's next round: by the new failures that they brought, or by the scenarios met least."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from random import Random

from sumo_adv.scenario_names import ScenarioName

Shown = tuple[str, Collection[ScenarioName]]
"""An episode: its input, and the named scenarios that its attempts show."""


def drawn_to_fail(
    inputs: Iterable[str], tries: Mapping[str, int], wins: Mapping[str, int], random: Random
) -> dict[str, float]:
    """Draw for each input how likely its next episode is to bring a new failure (Thompson 1933).

    Args:
        inputs: The inputs.
        tries: The number of episodes so far, by input; an input may be missing.
        wins: The number of episodes with a new failure, by input.
        random: The source of the draws.

    Returns:
        The drawn chance of each input.
    """
    drawn = {}
    for name in inputs:
        won = wins.get(name, 0)
        drawn[name] = random.betavariate(1 + won, 1 + tries.get(name, 0) - won)
    return drawn


def drawn_to_cover(inputs: Iterable[str], episodes: Iterable[Shown], random: Random) -> dict[str, float]:
    """Draw for each input how much its next episode adds to what was met least.

    For each scenario that the input has shown, the chance that it shows it again is drawn. That chance is divided by 1
    plus the number of episodes, over all inputs, that showed the scenario. The chance of a scenario that the input has
    never shown is drawn as well, and counts as never met.

    Args:
        inputs: The inputs.
        episodes: The episodes so far.
        random: The source of the draws.

    Returns:
        The drawn value of each input.
    """
    tries, met = Counter[str](), Counter[ScenarioName]()
    shown: dict[str, Counter[ScenarioName]] = {}
    for name, scenarios in episodes:
        tries[name] += 1
        met.update(set(scenarios))
        shown.setdefault(name, Counter()).update(set(scenarios))
    drawn = {}
    for name in inputs:
        made = tries[name]
        drawn[name] = random.betavariate(1, 1 + made)
        for scenario, times in sorted(shown.get(name, Counter()).items()):
            drawn[name] += random.betavariate(1 + times, 1 + made - times) / (1 + met[scenario])
    return drawn
