"""Define ``serve``: attack an ego that another program drives over TraCI, and write the server's folder."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv import app
from sumo_adv.cli import options as opt
from sumo_adv.cli.groups import grouped, named_settings
from sumo_adv.config import Settings, load_settings
from sumo_adv.datatypes import Ending
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import json_text, refuse_links, write_text
from sumo_adv.parsing import read_object
from sumo_adv.report.staging import scratch_folder, staged
from sumo_adv.serve import Mode, OnLoss, Options
from sumo_adv.serve.link import NEWEST_TRACI

if TYPE_CHECKING:
    from sumo_adv.episode.task import Task
    from sumo_adv.serve.events import Events, ResultWriter
    from sumo_adv.serve.gate import Gate
    from sumo_adv.serve.seat import GateEvent

SERVE_FILE = "serve.json"
SERVE_SCHEMA = 1
SERVES = re.compile(r"serve\.json|\.?encounter-\d+.*|inputs|report|.*\.jsonl")
"""Names of what a server, or ``report``, writes into the server's folder."""


def claim(target: Path, *, force: bool) -> None:
    """Make the output folder.

    Args:
        target: The folder.
        force: Whether an existing folder of another server is replaced.

    Raises:
        UsageError: The folder exists already, or cannot be made.
    """
    try:
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            if not force:
                raise UsageError(f"The output folder {target} already exists; give another --out, or --force.")
            _check_replaceable(target)
            shutil.rmtree(target)
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"The output folder {target} cannot be written ({error.strerror or error}).") from error


def _check_replaceable(target: Path) -> None:
    """Check that ``--force`` may replace a folder.

    Raises:
        UsageError: It is not the folder of a server, or it holds something else.
    """
    advice = "so --force does not replace it; give another --out"
    if target.is_symlink() or not (target / SERVE_FILE).is_file():
        raise UsageError(f"{target} is not the folder of a server, {advice}.")
    if "sumo_adv" not in read_object(target / SERVE_FILE, "The file").get("versions", ()):
        raise UsageError(f"{target} is not the folder of a server, {advice}.")
    refuse_links(target)
    for path in sorted(target.iterdir()):
        if not SERVES.fullmatch(path.name):
            raise UsageError(f"{target} holds {path.name}, which this program did not write, {advice}.")


def note(target: Path, given: Any, settings: Settings, options: Options, summary: Mapping[str, Any] | None) -> None:
    """Write ``serve.json``: the job of this server, and at the end its outcome.

    Args:
        target: The server's folder.
        given: The input.
        settings: The settings.
        options: The options of the server.
        summary: The outcome; None before the end.
    """
    from sumo_adv.report.outcome import versions

    secret = {"memory", "llm_api_key", "llm_base_url"}
    value = {
        "schema": SERVE_SCHEMA, "input": given.name, "versions": versions(), "options": asdict(options),
        "settings": settings.model_dump(mode="json", exclude=secret), "summary": summary,
    }  # fmt: skip
    write_text(target / SERVE_FILE, json_text(value, indent=2))


def folder_writer(target: Path) -> Callable[[Any, int], dict[str, Any]]:
    """Make a function that writes one encounter's folder whole.

    Inputs that several encounters share are stored once.

    Args:
        target: The server's folder.

    Returns:
        The function. It takes a run and its number, and returns the content of ``outcome.json`` with the folder.
    """
    from sumo_adv.campaigns.worker import share
    from sumo_adv.report.folder import write_run

    def write(run: Any, number: int) -> dict[str, Any]:
        with staged(target / f"encounter-{number:04d}", force=False, inside=True) as folder:
            result = write_run(folder, run)
            share(folder.stage / "inputs", target / "inputs")
            folder.keep(force=False)
        return {**result, "folder": folder.target}

    return write


EXAMPLE = (
    "Example: sumo-adv serve motorway --encounters 1, and in another terminal python examples/external_ego/idm_ego.py"
)
CONTINUOUS_SIMULATION_S = 3600.0  # default of the setting ``search`` in continuous mode


@dataclass(frozen=True)
class ClientOptions:
    """Options that say who may connect, and what is expected of the client."""

    mode: Annotated[
        Mode, typer.Option(help="continuous: encounter after encounter; episodes: repeat each encounter, refined.")
    ] = Mode.CONTINUOUS
    host: Annotated[str, typer.Option(help="Address to listen at; an address other than loopback needs --allow.")] = (
        "127.0.0.1"
    )
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port for the client; 0 = any free one.")] = 8813
    allow: Annotated[str, typer.Option(help="Addresses or networks that may connect, with commas between.")] = ""
    ego_id: Annotated[str | None, typer.Option(help="The vehicle of the demand that the client drives.")] = None
    ego_type: Annotated[str | None, typer.Option(help="vType of the inserted ego (default: SUMO's car).")] = None
    may_set: Annotated[
        str, typer.Option(help="What the client may set besides its own vehicle, with commas between: trafficlight, ..")
    ] = ""
    on_loss: Annotated[
        OnLoss, typer.Option(help="Who drives while the client is lost or late: sumo, brake, or end.")
    ] = OnLoss.SUMO
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Run in real time: a simulated second lasts a second.")
    ] = False
    deadline: Annotated[
        float | None,
        typer.Option(min=0.05, help="Seconds that the client may take for a step (default: 10, real time 2)."),
    ] = None
    patience: Annotated[
        float | None, typer.Option(min=0.1, help="Seconds to wait for a client before giving up (default: for ever).")
    ] = None
    traci_version: Annotated[
        int, typer.Option(min=21, max=22, help="Newest TraCI version that the client knows: 21 for Veins and similar.")
    ] = 22
    encounters: Annotated[
        int | None, typer.Option(min=1, help="Number of encounters after which it ends (default: at Ctrl-C).")
    ] = None


@dataclass(frozen=True)
class AttackOptions:
    """Options that say which attack is wanted."""

    adversary: opt.Adversary = None
    adversaries: opt.Adversaries = None
    trigger: opt.Trigger = None
    until: opt.UntilLevel = None
    attempts: opt.Attempts = None
    critical_ttc: opt.CriticalTtc = None


@dataclass(frozen=True)
class InputOptions:
    """Options of the simulation in which the client drives."""

    begin: opt.Begin = None
    end: Annotated[float | None, typer.Option(help="Simulation end, s; then the next simulation begins.")] = None
    density: opt.Density = None
    settings_file: opt.SettingsFile = None


@dataclass(frozen=True)
class SearchOptions:
    """Options that say how an attack is searched for, and with which bank and model."""

    llm: opt.Llm = None
    learn: opt.Learn = None
    memory: opt.Memory = None
    seed: opt.Seed = None


@dataclass(frozen=True)
class OutputOptions:
    """Options that say what is written and printed."""

    out: Annotated[Path | None, typer.Option(help="Folder to write (default: runs/serve-<input>-<seed>).")] = None
    force: Annotated[bool, typer.Option("--force", help="Replace another server's folder.")] = False
    events: Annotated[Path | None, typer.Option(help="File of JSON lines: everything that happens.")] = None
    status_port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port for /health and /status over HTTP, on loopback.")
    ] = None
    as_json: opt.AsJson = False


@grouped
def serve(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="INPUT", help="net.xml(.gz), .sumocfg, scenario .toml, .osm(.gz), .xodr, or a shipped name."
        ),
    ],
    client: ClientOptions, attack: AttackOptions, where: InputOptions, search: SearchOptions, output: OutputOptions,
) -> None:  # fmt: skip
    """Attack an ego that a program of yours drives over TraCI, encounter after encounter."""
    given = _input(source)
    settings = _settings(given, where.settings_file, named_settings(client, attack, where, search))
    if not output.as_json:
        for note in given.notes:
            typer.echo(note)
    if given.attackers:
        raise UsageError(f"{source} names vehicles that attack together, which serve cannot play: give it to run.")
    if settings.adversaries > 1 and client.real_time:
        raise UsageError(
            "With --real-time, nothing waits until supports are predicted, so it allows only one adversary: leave out "
            "--real-time or --adversaries."
        )
    if client.mode is Mode.CONTINUOUS and "search" not in settings.model_fields_set:
        settings = settings.model_copy(update={"search": CONTINUOUS_SIMULATION_S})
    _serve(given, settings, _options(client), output)


def _settings(given: Any, file: Path | None, named: Mapping[str, Any]) -> Settings:
    from sumo_adv.simulation.inputs import own_simulation

    return load_settings(file, **{**own_simulation(given), **named, "ego": "external", "horizon": given.horizon})


def _options(client: ClientOptions) -> Options:
    return Options(
        client.host, client.port, tuple(opt.words(client.allow)), client.mode, client.on_loss, client.real_time,
        client.encounters, client.ego_type, tuple(opt.words(client.may_set)), client.patience, client.deadline,
        client.traci_version < NEWEST_TRACI,
    )  # fmt: skip


def _input(source: Path) -> Any:
    """Load the input.

    Raises:
        UsageError: The input is bad or plays a log back, or the program ``sumo`` is not installed.
    """
    from sumo_adv.simulation.programs import find_sumo

    find_sumo()
    run_input = app.load(source, None)
    if run_input.playback is not None:
        raise UsageError(f"{source} plays a log back, which serve does not do: give a scenario without tracks.")
    if run_input.moves or run_input.sight:
        raise UsageError(f"{run_input.path} has moves or sight of its ego, which serve does not know: take them out.")
    return run_input


def _serve(given: Any, settings: Settings, options: Options, output: OutputOptions) -> None:
    """Serve clients until the encounters are done or the user interrupts."""
    from sumo_adv.cli.interrupts import Interrupts
    from sumo_adv.cli.progress import ServeProgress
    from sumo_adv.report.outcome import MODEL_FILE
    from sumo_adv.serve.events import EventFile, Events, ResultWriter, Status, StatusPage
    from sumo_adv.serve.server import EgoServer, ServerDependencies
    from sumo_adv.simulation.network import read_network

    target = output.out or Path("runs") / f"serve-{given.name}-{settings.seed}"
    with ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        scratch = stack.enter_context(scratch_folder())
        task_for = _tasks(given, settings, scratch)
        road = read_network(task_for(0).spec.network)
        bank = stack.enter_context(app.open_for_run(settings))
        sandbox = stack.enter_context(app.new_sandbox(settings))
        status, terminal = Status(), ServeProgress(quiet=output.as_json)
        listeners: list[Any] = [status, terminal]
        if output.events is not None:
            listeners.append(file := EventFile(output.events))
            stack.callback(file.close)
        events = Events(*listeners)
        gate = stack.enter_context(_gate(options, events))
        claim(target, force=output.force)
        agents = stack.enter_context(app.open_agents(settings, sandbox, target / MODEL_FILE))
        note(target, given, settings, options, None)
        writer = ResultWriter(folder_writer(target), events)
        stack.enter_context(terminal)
        parts = ServerDependencies(given, options, task_for, road, agents, bank, gate, events, writer, interrupts.check)
        server = EgoServer(parts)
        if output.status_port is not None:
            page = stack.enter_context(StatusPage(output.status_port, lambda: {**status.report(), "time": server.time}))
            events.tell("status_page", port=page.port)
        events.tell(
            "listening", host=options.host, port=gate.port, ego=server.ego, mode=str(options.mode), opens=gate.opens,
            added=server.ego_is_added,
        )  # fmt: skip
        try:
            ending = server.run()
        finally:
            interrupts.hold()
            writer.close()
        summary = _summary(ending, server.reason, writer, target)
        events.tell("stopped", **summary)
        note(target, given, settings, options, summary)
    _finish(ending, summary, writer, options, as_json=output.as_json)


def _gate(options: Options, events: Events) -> Gate:
    from sumo_adv.serve.gate import Gate
    from sumo_adv.serve.policy import Rules

    return Gate(
        options.host, options.port, allow=options.allow, deadline=options.turn, older=options.older,
        rules=Rules(frozenset(options.may_set)), on_event=_teller(events),
    )  # fmt: skip


def _teller(events: Events) -> Callable[[GateEvent], None]:
    """Report what happens at the gate.

    The events tell by ``again`` if a client only comes back to a new simulation.
    """
    from sumo_adv.serve.seat import EventKind

    before = EventKind.CLOSED

    def print_event(event: GateEvent) -> None:
        nonlocal before
        again = event.kind is EventKind.CONNECTED and before is EventKind.RESTARTED
        before = event.kind
        events.tell("client", state=str(event.kind), sentence=event.sentence, again=again)

    return print_event


def _tasks(given: Any, settings: Settings, scratch: Path) -> Callable[[int], Task]:
    """Make the task of each simulation: the same input with the next seed."""
    from sumo_adv.episode.task import make_task

    @cache
    def first() -> Task:
        return make_task(given, settings, scratch)

    def task_for(round_: int) -> Task:  # only the first one is needed again
        if round_ == 0:
            return first()
        return make_task(given, settings.model_copy(update={"seed": settings.seed + round_}), scratch)

    return task_for


def _summary(ending: Ending | None, reason: str, writer: ResultWriter, target: Path) -> dict[str, Any]:
    return {
        "ending": None if ending is None else str(ending), "reason": reason, "encounters": writer.written,
        "critical": writer.critical, "collisions": writer.collided, "folder": str(target),
    }  # fmt: skip


def _finish(
    ending: Ending | None, summary: Mapping[str, Any], writer: ResultWriter, options: Options, *, as_json: bool
) -> None:
    """Print the summary.

    Raises:
        SumoAdvError: A folder could not be written, or the server ended early.
    """
    if as_json:
        typer.echo(json.dumps(summary, ensure_ascii=False))
    else:
        typer.echo(
            f"Encounters: {summary['encounters']}, critical: {summary['critical']}, "
            f"collisions: {summary['collisions']}. Files: {summary['folder']}"
        )
        if ending is None and summary["reason"]:
            typer.echo(summary["reason"])
    if writer.failure is not None:
        raise SumoAdvError(str(writer.failure))
    interrupted = ending is Ending.INTERRUPTED and options.encounters is None  # such a server is meant to end by Ctrl-C
    if ending is not None and not interrupted:
        raise SumoAdvError(summary["reason"])
