"""Define ``batch``: run many episodes on every core, and resume where an earlier call stopped."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from sumo_adv.app import check_intents, run_campaign
from sumo_adv.campaigns.results import Learn
from sumo_adv.cli import options as opt
from sumo_adv.cli.groups import grouped, named_settings
from sumo_adv.cli.options import INPUT_PANEL, OUTPUT_PANEL, RUNNING_PANEL, SEARCH_PANEL, option, set_values, words
from sumo_adv.errors import UsageError
from sumo_adv.files import sentences
from sumo_adv.memory.store import default_bank_path
from sumo_adv.report.staging import staged
from sumo_adv.simulation.warnings_log import kinds_below, said_of

if TYPE_CHECKING:
    from sumo_adv.campaigns.campaign import Orders, Summary
    from sumo_adv.campaigns.plan import CampaignPlan

EXAMPLE = "Example: sumo-adv batch scenarios --egos idm,careful --seeds 10 --out campaigns/first"


class _DefaultGroup(TyperGroup):
    """Treats ``batch PLAN`` as ``batch run PLAN``. Only the other commands must be named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or args[0] not in self.commands:
            args = ["run", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_DefaultGroup, add_completion=False, pretty_exceptions_enable=False,
    help="Run many episodes: inputs x egos x settings x seeds. See also: batch pack, batch unpack.",
)  # fmt: skip


Given = Annotated[
    list[str],
    typer.Argument(metavar="PLAN | INPUT...", help="A plan .toml; or networks, maps, scenarios, records, folders."),
]
Memory = Annotated[
    Path | None, option(SEARCH_PANEL, "Memory bank; episodes read a snapshot of it.", default="your own")
]


@dataclass(frozen=True)
class InputOptions:
    """Options that say what is run."""

    seeds: Annotated[str | None, option(INPUT_PANEL, "Number of seeds, from 0; or a list: 3,7,11.", default="1")] = None
    egos: Annotated[str | None, option(INPUT_PANEL, "krauss,idm,module:Class ...", default="the input's")] = None
    records: Annotated[str | None, option(INPUT_PANEL, "Of .tfrecord files: ids or places.", default="all")] = None
    setting: Annotated[
        list[str] | None, option(INPUT_PANEL, "A setting of every episode; repeatable.", "--set", metavar="NAME=VALUE")
    ] = None
    odd: Annotated[
        Path | None,
        option(INPUT_PANEL, "TOML file of an operational design domain: attack only within it.", default="none"),
    ] = None
    settings_file: opt.SettingsFile = None


@dataclass(frozen=True)
class AttackOptions:
    """Options that say which attack is wanted."""

    until: opt.UntilLevel = None
    ttc: opt.Ttc = None
    critical_ttc: opt.CriticalTtc = None
    min_delta_v: opt.MinDeltaV = None
    intents: opt.Intents = None
    exclude: opt.Exclude = None
    kind: opt.Kind = None
    scenario: opt.Scenario = None
    adversaries: opt.Adversaries = None
    diverse: opt.Diverse = None
    attempts: opt.Attempts = None
    seconds: opt.Seconds = None


@dataclass(frozen=True)
class BankOptions:
    """Options of the batch's memory bank."""

    learn: Annotated[
        Learn | None,
        option(
            SEARCH_PANEL,
            "When the bank learns: off, after (all, in order), during (rows depend on order).",
            default="off",
        ),
    ] = None
    memory: Memory = None


@dataclass(frozen=True)
class RunningOptions:
    """Options that say how the episodes are run."""

    workers: opt.Workers = None
    deadline: Annotated[
        float, option(RUNNING_PANEL, "Seconds after which an episode counts as stuck.", default="600", min=1)
    ] = 600.0
    recycle: Annotated[
        int, option(RUNNING_PANEL, "Episodes after which a worker is replaced.", default="200", min=1)
    ] = 200
    ray: opt.RayCluster = None
    retry_failed: Annotated[bool, option(RUNNING_PANEL, "Rerun failed episodes.", "--retry-failed")] = False
    dry_run: Annotated[bool, option(RUNNING_PANEL, "Print the episodes and run none.", "--dry-run")] = False
    force: Annotated[bool, option(RUNNING_PANEL, "Continue in a folder of another plan.", "--force")] = False


@dataclass(frozen=True)
class OutputOptions:
    """Options that say what is written and printed."""

    figures: Annotated[bool | None, option(OUTPUT_PANEL, "Draw encounter.png for each run.", default="no")] = None
    out: Annotated[Path | None, option(OUTPUT_PANEL, "Folder of results.", default="runs/<plan>")] = None
    parquet: Annotated[bool, option(OUTPUT_PANEL, "Write results.parquet as well.", "--parquet")] = False
    states: Annotated[
        bool, option(OUTPUT_PANEL, "Write states.parquet as well: all vehicles of every run.", "--states")
    ] = False
    as_json: opt.AsJson = False


@app.command("run", epilog=EXAMPLE)
@grouped
def batch(
    given: Given, what: InputOptions, attack: AttackOptions, bank: BankOptions, running: RunningOptions,
    output: OutputOptions,
) -> None:  # fmt: skip
    """Run every input with every ego and every seed; rerun the same command to run what is missing.

    Ctrl-C finishes the episodes that run; twice, it stops now. Also: batch pack OUT, batch unpack OUT.
    """
    from sumo_adv.api_batch import orders_of
    from sumo_adv.campaigns.plan import is_plan

    if output.parquet or output.states:
        from sumo_adv.campaigns.results import check_parquet

        check_parquet()
    plan = _plan(given, what, attack, bank, output.figures)
    check_intents(plan.variants, plan.memory or default_bank_path())
    first = Path(given[0])
    target = output.out or Path("runs") / (first.stem if len(given) == 1 and is_plan(first) else "batch")
    if running.dry_run:
        _show(plan, target, as_json=output.as_json)
        return
    orders = orders_of(
        plan, target, running.workers, running.deadline, running.recycle, force=running.force,
        retry_failed=running.retry_failed, parquet=output.parquet, ray=running.ray,
    )  # fmt: skip
    _run(plan, orders, states=output.states, as_json=output.as_json)


def _plan(
    given: list[str], what: InputOptions, attack: AttackOptions, bank: BankOptions, figures: bool | None
) -> CampaignPlan:
    from sumo_adv.api_batch import planned

    overrides = {
        "seeds": None if what.seeds is None else _seeds(what.seeds),
        "egos": None if what.egos is None else words(what.egos),
        "records": None if what.records is None else words(what.records),
        "learn": bank.learn, "memory": bank.memory, "figures": figures,
    }  # fmt: skip
    chosen = {**set_values(what.setting or [], "attempts=5"), **named_settings(attack)}
    return planned(given, overrides, chosen, what.odd, what.settings_file)


def _seeds(text: str) -> int | list[int]:
    numbers = [word.strip() for word in text.split(",")]
    if not all(each.isascii() and each.isdigit() for each in numbers):
        raise UsageError(f"--seeds takes a number of seeds or a list such as 3,7,11, not '{text}'.")
    return int(text) if len(numbers) == 1 else [int(each) for each in numbers]


def _show(plan: CampaignPlan, out: Path, *, as_json: bool) -> None:
    rows = [
        {
            "id": job.id, "input": job.input.name, "ego": job.ego, "seed": job.seed, **plan.varied[job.variant],
            "broken": job.input.error or None,
        }
        for job in plan.jobs
    ]  # fmt: skip
    if as_json:
        typer.echo(json.dumps({"out": str(out), "learn": str(plan.learn), "episodes": rows}))
        return
    for row in rows:
        more = " ".join(f"{k}={v}" for k, v in row.items() if k not in ("id", "input", "ego", "seed", "broken"))
        broken = f"  cannot be run: {row['broken']}" if row["broken"] else ""
        line = f"{row['id']}  {row['input']}  {row['ego'] or '-'}  seed {row['seed']}  {more}"
        typer.echo(f"{line.rstrip()}{broken}")
    twice = f", {plan.size - len(rows)} of the same content left out" if plan.size > len(rows) else ""
    typer.echo(f"{len(rows)} episodes{twice}, into {out}.")


def _run(plan: CampaignPlan, orders: Orders, *, states: bool, as_json: bool) -> None:
    from sumo_adv.cli.progress import BatchProgress

    for note in () if as_json else (note for given in plan.inputs for note in given.notes):
        typer.echo(note)
    if plan.learn == "during" and not as_json:
        typer.echo("With --learn during, the rows depend on the order in which episodes finish.", err=True)
    with BatchProgress(quiet=as_json) as watcher:
        summary = run_campaign(plan, orders, watcher, states=states)
    typer.echo(json.dumps(summary.as_dict()) if as_json else _words_of(summary))
    if summary.stopped:
        typer.echo("sumo-adv: stopped; rerun the same command to run the rest.", err=True)
    if summary.stopped or (summary.rows and all(r["failure"] for r in summary.rows)):
        raise typer.Exit(1)


def _words_of(summary: Summary) -> str:
    s = summary.as_dict()
    lines = [
        f"{s['finished']} of {s['episodes']} episodes: {s['critical']} critical, {s['collided']} collided, "
        f"{s['valid']} valid ({s['humanlike']} humanlike, {s['robust']} robust), {s['failed']} failed."
    ]
    if summary.ran:
        size = f"{s['bytes_an_episode'] / 1000:.0f} kB per episode, {s['input_bytes'] / 1000:.0f} kB of inputs"
        lines.append(f"{summary.ran} run now in {s['seconds']:.0f} s; {size}.")
    if s["driver_calls"]:
        total = sum(float(r["seconds"] or 0.0) for r in summary.rows)
        mean = 1e3 * s["driver_seconds"] / s["driver_calls"]
        lines.append(
            f"The egos' drivers took {s['driver_seconds']:.0f} of the {total:.0f} s of all episodes: "
            f"{s['driver_calls']:,} calls, mean {mean:.2g} ms, 99 % within {s['driver_p99_ms']:.2g} ms in each episode."
        )
    if summary.learnt is not None:
        lines.append(f"{summary.learnt} pieces of evidence were added to the memory bank.")
    lines += said_of(kinds_below(summary.folder))
    lines.append(f"Files: {summary.folder / 'results.csv'}")
    return "\n".join(lines)


@app.command("pack", epilog="Example: sumo-adv batch pack runs/plan")
def pack(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="The folder of a batch.")],
    most: Annotated[int, typer.Option(min=1, help="Number of runs per file.")] = 1000,
    as_json: opt.AsJson = False,
) -> None:
    """Move finished runs into a few zip files; the table still works, and the batch can still be continued."""
    from sumo_adv.api_batch import Campaign
    from sumo_adv.campaigns.store import open_store, pack_runs

    with open_store(Campaign(folder).folder, staged):
        done = pack_runs(folder, most)
    if as_json:
        typer.echo(json.dumps(asdict(done)))
        return
    before, after = done.bytes[0] / 1e6, done.bytes[1] / 1e6
    typer.echo(f"{done.runs} runs: {done.files[0]} files became {done.files[1]}, {before:.1f} MB {after:.1f} MB.")


@app.command("unpack", epilog="Example: sumo-adv batch unpack runs/plan 0f3a5c6e7d8b9a10")
def unpack(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="The folder of a batch.")],
    names: Annotated[list[str] | None, typer.Argument(metavar="[ID]...", help="Runs (default: all).")] = None,
    as_json: opt.AsJson = False,
) -> None:
    """Unpack runs into folders below OUT/unpacked; the packs stay."""
    from sumo_adv.api_batch import Campaign
    from sumo_adv.campaigns.store import unpack_runs

    target = Campaign(folder).folder / "unpacked"  # not a link, because a campaign's folder holds none
    with sentences(target):
        made = unpack_runs(folder, names or [], target, staged)
    if as_json:
        typer.echo(json.dumps({"folders": [str(p) for p in made]}))
    else:
        typer.echo(f"{len(made)} runs into {target}.")
