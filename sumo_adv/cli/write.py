"""Define ``write``: make a scenario from words or a crash report, and run it."""

from __future__ import annotations

import datetime
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv import app
from sumo_adv.cli import options as opt
from sumo_adv.cli.groups import grouped, named_settings
from sumo_adv.cli.options import INPUT_PANEL, OUTPUT_PANEL, option
from sumo_adv.config import Settings, Until, load_settings
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import sentences
from sumo_adv.parsing import read_toml
from sumo_adv.report.staging import scratch_folder, staged

if TYPE_CHECKING:
    from sumo_adv.words.author import Played

EXAMPLE = 'Example: sumo-adv write "A car squeezes in right before me and brakes." --out my.toml --llm deepseek-chat'
MAX_REPORT_BYTES = 100_000  # largest report
COMPANION_ENDINGS = (".rou.xml", ".net.xml", ".add.xml")  # files that a scenario may have beside it


@dataclass(frozen=True)
class OutputOptions:
    """Options that say what is written."""

    out: Annotated[Path, option(OUTPUT_PANEL, "Scenario to write.", metavar="FILE.toml", default="written.toml")] = (
        Path("written.toml")
    )
    run_out: Annotated[
        Path | None, option(OUTPUT_PANEL, "Folder of its run.", "--run-out", default="runs/<scenario>")
    ] = None

    @property
    def folder(self) -> Path:
        """The folder of the scenario's run."""
        return self.run_out or Path("runs") / self.out.stem


@dataclass(frozen=True)
class RunOptions:
    """Options of the run."""

    llm: opt.Llm = None
    ego: opt.Ego = None
    attempts: opt.Attempts = None
    seconds: opt.Seconds = None
    seed: opt.Seed = None
    memory: opt.Memory = None


@grouped
def write(
    words: Annotated[str | None, typer.Argument(help="What happens in the scenario, in any language.")] = None,
    report: Annotated[
        Path | None, option(INPUT_PANEL, "File with the words, such as a crash report.", default="none")
    ] = None,
    network: Annotated[
        Path | None, option(INPUT_PANEL, "Your own network for the scenario.", default="chosen by the model")
    ] = None,
    *,
    output: OutputOptions,
    run: RunOptions,
    settings_file: opt.SettingsFile = None,
    force: Annotated[bool, option(OUTPUT_PANEL, "Replace the scenario and the folder of its run.", "--force")] = False,
    as_json: opt.AsJson = False,
) -> None:
    """Make a scenario from words with a language model, run it, and report whether the result fits the words."""
    from sumo_adv.words.request import checked_words, needs_model

    request = checked_words(_request(words, report))
    settings = load_settings(settings_file, **named_settings(run))
    model = settings.player("analyzer")
    if model is None:
        raise needs_model("Making a scenario from words", request)
    out, folder = output.out, output.folder
    if out.suffix != ".toml" or not out.stem:
        raise UsageError(f"The scenario {out} needs the ending .toml.")
    _refuse_what_is_there(out, folder, force=force)
    given = [file for file in (report, settings_file) if file is not None]
    if network is not None:
        given += app.load(network, None).files
    _refuse_given(given, out)
    made = _write(request, model, settings, network, out, folder, force=force, quiet=as_json)
    typer.echo(json.dumps(_as_json(made, out, folder)) if as_json else _three_lines(made, out, folder))


def _request(words: str | None, report: Path | None) -> str:
    """Return the words of the command line, or those of a report.

    Raises:
        UsageError: Both or none are given, or the report cannot be read.
    """
    if (words is None) == (report is None):
        raise UsageError('Give either words, such as sumo-adv write "A car cuts in.", or --report FILE, not both.')
    if report is None:
        return words or ""
    try:
        data = report.read_bytes()[: MAX_REPORT_BYTES + 1]
        if len(data) > MAX_REPORT_BYTES:
            raise UsageError(
                f"The report {report} has more than {MAX_REPORT_BYTES} bytes; give the part with the motion."
            )
        return data.decode("utf-8")
    except OSError as error:
        raise UsageError(f"The report {report} cannot be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"The report {report} is not text in UTF-8.") from error


def _refuse_what_is_there(out: Path, folder: Path, *, force: bool) -> None:
    """Refuse to replace files unless ``force`` is given."""
    taken = [p for p in (out, *_beside(out), folder) if p.exists()]
    if taken and not force:
        raise UsageError(f"{taken[0]} already exists; give another --out, or --force to replace it.")


def _refuse_given(given: Sequence[Path], out: Path) -> None:
    """Refuse to write the scenario over a file that the user gave, even with --force."""
    for place in (p for p in (out, *_beside(out)) if p.exists()):
        if any(place.samefile(file) for file in given):
            raise UsageError(f"The scenario would replace {place}, which you gave as an input; give another --out.")


def _beside(scenario: Path) -> list[Path]:
    """List the files that a scenario may have beside it."""
    return [scenario.with_name(f"{scenario.stem}{ending}") for ending in COMPANION_ENDINGS]


def _written_with(scenario: Path) -> list[Path]:
    """List the files beside a scenario that ``write`` made with it; none if it made no such scenario."""
    try:
        if "written" not in read_toml(scenario, "The scenario"):
            return []
        used = app.load(scenario, None).files
    except (SumoAdvError, OSError):  # another file, or an incomplete scenario
        return []
    return [p for p in _beside(scenario) if p.exists() and any(p.samefile(file) for file in used)]


def _write(
    request: str, model: str, settings: Settings, network: Path | None, out: Path, folder: Path, *, force: bool,
    quiet: bool,
) -> Played:  # fmt: skip
    """Have the scenario written and run, and put its files at ``out`` and in ``folder``."""
    from sumo_adv.agents.inventions import Inventions
    from sumo_adv.llm.asking import MeteredModel
    from sumo_adv.llm.chat import Ledger
    from sumo_adv.llm.client import open_model
    from sumo_adv.llm.recording import Recorder
    from sumo_adv.report.outcome import MODEL_FILE
    from sumo_adv.words.author import Author

    ledger = Ledger.for_settings(settings)
    player = open_model(model, settings, ledger)
    played_by = settings.model_copy(
        update={"llm": None, "analyzer": None, "generator": None, "modifier": None, "learn": "off"}
    )
    today = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
    with scratch_folder() as scratch, staged(folder, force=force) as target:
        with Recorder(scratch / MODEL_FILE, player.name) as recorder:
            metered = MeteredModel(recorder.wrap(player), ledger)
            with app.open_for_run(settings) as bank, app.new_sandbox(settings) as sandbox:
                inventions = Inventions(
                    metered, app.shipped_prompts(), settings, sandbox, bank, scratch / "bank.sqlite"
                )  # fmt: skip
                author = Author(
                    metered, app.shipped_prompts(), app.known_intents(bank),
                    lambda file, place, goal: _run(file, place, goal, inventions.used_by(played_by)), inventions.add,
                    scratch, out.stem, today, network,
                    (lambda _: None) if quiet else (lambda line: typer.echo(line, err=True)),
                )  # fmt: skip
                made = author.write(request)
                attack = made.scene.attack
                if attack.novel is not None and made.reached and not made.misfits:
                    inventions.keep(attack.novel.label)
                if attack.script is not None and made.reached and not made.misfits:
                    inventions.keep_script(attack.script)
        with sentences(out):
            out.parent.mkdir(parents=True, exist_ok=True)
            for old in _written_with(out):
                old.unlink()
            for file in (made.scenario, *_beside(made.scenario)):
                if file.exists():
                    shutil.copyfile(file, out.with_name(file.name))
        shutil.copytree(made.folder, target.stage, dirs_exist_ok=True)
        shutil.copyfile(scratch / MODEL_FILE, target.stage / MODEL_FILE)
        target.keep(force=force)
    return made


def _run(scenario: Path, folder: Path, goal: Mapping[str, Any], settings: Settings) -> dict[str, Any]:
    """Run a scenario into a folder, and return the content of its ``outcome.json``."""
    from sumo_adv.report.folder import write_run

    run_input = app.load(scenario, None)
    goal = {"until": Until(str(goal["until"])), "ttc": goal.get("ttc")}
    brought = {key: value for key, value in run_input.settings(["until"]).items() if value is not None}
    wanted = settings.model_copy(update={**brought, **goal})
    with staged(folder, force=False) as target, scratch_folder() as scratch:
        run = app.play(run_input, wanted, target.stage, scratch, lambda *_: None)
        result = write_run(target, run)
        target.keep(force=False)
    return result


def _as_json(made: Played, out: Path, folder: Path) -> dict[str, Any]:
    reading = made.reading
    return {
        "scenario": str(out), "folder": str(folder), "understood": made.draft.understood,
        "left_out": made.draft.left_out or None, "level": str(made.level), "reached": made.reached,
        "fits": not made.misfits, "misfits": made.misfits, "parts": (made.outcome["asked"] or {}).get("parts", []),
        "happened": None if reading is None else reading.happened, "read": reading is not None,
        "motion": (made.outcome["asked"] or {}).get("motion"), "attempts": len(made.outcome["attempts"]),
    }  # fmt: skip


def _three_lines(made: Played, out: Path, folder: Path) -> str:
    from sumo_adv.llm.prompts import sanitize
    from sumo_adv.words.fit import held

    scene, reading = made.scene, made.reading
    others = len(scene.vehicles) + len(scene.walkers) + len(scene.parked)
    tried = f"{len(made.outcome['attempts'])} of {made.outcome['attempts_allowed']} attempts"
    road = scene.road.name if scene.road.kind == "shipped" else f"{scene.road.kind} road"
    left = f" Left out: {sanitize(made.draft.left_out)}" if made.draft.left_out else ""
    told = sanitize(reading.happened) if reading is not None else "see the page of the run."
    if made.outcome["best"] is None:
        told = made.outcome["reason"]
    by = "by the rules and to a reader" if reading is not None else "by the rules; no reader has read it"
    missed = "" if made.reached else f" The goal was not reached: {made.outcome['goal']}."
    holds = held((made.outcome["asked"] or {}).get("parts", []))
    fits = f"yes, {by}." if not made.misfits else f"no: {sanitize(' '.join(made.misfits))} {holds}".rstrip()
    return "\n".join(
        (
            f"Built: {sanitize(made.draft.understood)} ({road}, other road users: {others}; {out}).{left}",
            f"Happened: {made.result} after {tried} ({folder}). {told}",
            f"Fits: {fits}{missed}",
        )
    )
