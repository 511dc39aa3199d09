"""Define ``rate``: estimate how often the ego crashes in normal traffic, by importance sampling."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sumo_adv.app import estimate_rate
from sumo_adv.cli.groups import grouped
from sumo_adv.cli.options import EGO_PANEL, INPUT_PANEL, OUTPUT_PANEL, SEARCH_PANEL, AsJson, RayCluster, Workers, option

if TYPE_CHECKING:
    from sumo_adv.rate.estimate import RateEstimate

EXAMPLE = "Example: sumo-adv rate straight_2lane --ego idm --runs 1000"


Source = Annotated[Path, typer.Argument(metavar="INPUT", help="net.xml(.gz), .sumocfg, scenario .toml, or a name.")]
Ego = Annotated[
    str | None,
    option(EGO_PANEL, "Driver under test: idm, careful, module:Class ...", default="as the input says, or idm"),
]
Runs = Annotated[int, option(SEARCH_PANEL, "Number of runs for the estimate, in blocks of 20.", default="1000", min=1)]
Errors = Annotated[float, option(INPUT_PANEL, "Factor on the rates of all human errors.", default="1", min=0)]
Out = Annotated[
    Path | None,
    option(
        OUTPUT_PANEL, "Folder of runs; rerun the same command to continue there.", default="runs/rate-<input>-<ego>"
    ),
]


@dataclass(frozen=True)
class SamplingOptions:
    """Options that say how many runs are drawn, and from what."""

    runs: Runs = 1000
    pilot: Annotated[
        int, option(SEARCH_PANEL, "Number of earlier runs, from which the proposal learns.", default="200", min=1)
    ] = 200
    plain: Annotated[bool, option(SEARCH_PANEL, "Sample all runs from the model: plain Monte Carlo.", "--plain")] = (
        False
    )
    seed: Annotated[int, option(SEARCH_PANEL, "Seed of traffic and errors.", default="0", min=0)] = 0


@dataclass(frozen=True)
class TrafficOptions:
    """Options of the traffic in which the ego drives."""

    duration: Annotated[
        float, option(INPUT_PANEL, "Maximum time that the ego drives in a run, s.", default="60", min=1)
    ] = 60.0
    warm_up: Annotated[
        float, option(INPUT_PANEL, "Warm-up of generated traffic before the ego departs, s.", default="20", min=0)
    ] = 20.0
    density: Annotated[
        float | None, option(INPUT_PANEL, "Departures per minute of generated traffic.", default="by lanes")
    ] = None
    errors: Errors = 1.0


@grouped
def rate(
    source: Source, *, ego: Ego = None, sampling: SamplingOptions, traffic: TrafficOptions, workers: Workers = None,
    ray: RayCluster = None, out: Out = None, as_json: AsJson = False,
) -> None:  # fmt: skip
    """Estimate how often the ego crashes in an hour and in a kilometre of normal traffic, in which drivers err.

    Errors that look dangerous are sampled more often, and each run is weighted for that. docs/rate.md says what the
    figures may be used for.
    """
    from sumo_adv.api_batch import Teller
    from sumo_adv.cli.progress import Counter
    from sumo_adv.rate.blocks import RatePlan
    from sumo_adv.simulation.inputs import input_name

    plan = RatePlan(
        source, ego, density=traffic.density, warm_up=traffic.warm_up, duration=traffic.duration,
        factor=traffic.errors, pilot=sampling.pilot, plain=sampling.plain, seed=sampling.seed,
    )  # fmt: skip
    target = out or Path("runs") / f"rate-{input_name(source)}-{(ego or 'ego').replace(':', '.')}"
    counter = Counter("blocks", quiet=as_json)
    watcher = Teller(lambda told, job, _: counter.tell(told.done, told.total, f"{job.phase}: "), _stopping)
    estimate = estimate_rate(plan, target, sampling.runs, workers, watcher, ray)
    counter.close()
    if estimate is None:
        typer.echo(f"sumo-adv: stopped; rerun the same command to continue in {target}.", err=True)
        raise typer.Exit(1)
    typer.echo(json.dumps({**estimate.document(), "folder": str(target)}) if as_json else "\n".join(lines(estimate)))


def lines(found: RateEstimate) -> list[str]:
    """Describe an estimate in a table and sentences."""
    words = ("per 1000 h", "per million km", "half width", "crashes", "plain runs")
    shown = ["{:<10} {:>26} {:>26} {:>10} {:>7} {:>10}".format("level", *words)]
    for level, hourly in found.per_hour.items():
        per_km = found.per_km[level]
        half = "-" if hourly.half_width is None else f"{hourly.half_width:.0%}"
        plain = "-" if hourly.plain_runs is None else f"{hourly.plain_runs:.0f}"
        shown.append(
            f"{level:<10} {_span(hourly.value, hourly.low, hourly.high, 1e3):>26} "
            f"{_span(per_km.value, per_km.low, per_km.high, 1e6):>26} {half:>10} {hourly.crashes:>7} {plain:>10}"
        )
    collision = found.per_hour["collision"]
    worth = f"{found.runs} runs, effective sample size {found.effective_runs:.0f}"
    shown.append(f"{worth}; {found.hours:.2f} h, {found.km:.1f} km driven.")
    if collision.largest_share is not None and found.plain_km is not None:
        shown.append(
            f"Collisions: effective sample size {collision.effective:.1f}, largest weight "
            f"{collision.largest_share:.0%}; plain sampling needs {found.plain_km:.0f} km for the same precision."
        )
        causes = sorted(found.by_error.items(), key=lambda item: -item[1])
        shown.append("Errors before collisions: " + ", ".join(f"{name} {share:.0%}" for name, share in causes))
    return shown


def _span(value: float, low: float, high: float, unit: float) -> str:
    return f"{value * unit:.3g} ({low * unit:.3g}-{high * unit:.3g})"


def _stopping(now: bool) -> None:
    if not now:
        typer.echo("sumo-adv: finishing the blocks that run; Ctrl-C again stops now.", err=True)
