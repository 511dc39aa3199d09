"""``transformer``: scenes to learn from, training, and evaluation of the motion predictor of the benchmark's row."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sumo_adv.cli.progress import PROGRESS_PERIOD_S
from sumo_adv.errors import UsageError
from sumo_adv.files import sentences

if TYPE_CHECKING:
    from sumo_adv.transformer.train import Score

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="The motion predictor of the row 'transformer': make scenes, train, evaluate.",
)  # fmt: skip
WOMD_PREFIX = "womd:"
PREDICTOR_COLUMNS = ("predictor", "minADE [m]", "minFDE [m]", "miss rate", "ADE [m]", "FDE [m]", "vehicles")

Scenes = Annotated[Path, typer.Argument(metavar="SCENES", help="The folder that transformer data wrote.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")]


@app.command("data", epilog="Example: sumo-adv transformer data --out runs/scenes")
def data(
    source: Annotated[str, typer.Argument(help="sumo, or womd:FOLDER with Waymo records.")] = "sumo",
    out: Annotated[Path, typer.Option(help="Folder; the same one goes on.")] = Path("runs/scenes"),
    seed: Annotated[int, typer.Option(min=0, help="Of networks, traffic and the choice of scenes.")] = 0,
    runs: Annotated[int, typer.Option(min=1, help="Runs of SUMO to train on; an eighth as many are held out.")] = 200,
    as_json: Json = False,
) -> None:
    """Make scenes to train on and held-out ones: of SUMO's traffic on networks of ours, or of Waymo records."""
    from sumo_adv.transformer.dataset import make

    with sentences(out), _going_on():
        out.mkdir(parents=True, exist_ok=True)
        progress = _progress("runs")
        if source.startswith(WOMD_PREFIX):
            from sumo_adv.womd.training_scenes import make_from_records

            made = make_from_records(Path(source.removeprefix(WOMD_PREFIX)), out, progress)
        elif source == "sumo":
            made = make(out, seed=seed, runs=runs, progress=progress)
        else:
            raise UsageError(f"There is no source '{source}' of scenes; give sumo or womd:FOLDER.")
    typer.echo(json.dumps({"folder": str(out), "files": made}) if as_json else f"{made} files of scenes in {out}.")


@app.command("train", epilog="Example: sumo-adv transformer train runs/scenes --out runs/transformer")
def train(
    scenes: Scenes,
    out: Annotated[Path, typer.Option(help="Folder; the same one goes on.")] = Path("runs/transformer"),
    seed: Annotated[int, typer.Option(min=0, help="Of the first weights and the order of scenes.")] = 0,
    epochs: Annotated[int, typer.Option(min=1, help="How often each scene is seen.")] = 5,
    steps: Annotated[int | None, typer.Option(min=1, help="End after these steps (default: after the epochs).")] = None,
    as_json: Json = False,
) -> None:
    """Train on scenes (extra train: JAX, on one thread of the CPU), from where the folder's training stands."""
    from sumo_adv.transformer.dataset import TRAIN, load
    from sumo_adv.transformer.train import train as run

    with sentences(out), _going_on():
        dataset = load(scenes, TRAIN)
        out.mkdir(parents=True, exist_ok=True)
        weights = run(dataset, out, seed=seed, epochs=epochs, steps=steps, progress=_progress("steps"))
    typer.echo(json.dumps({"weights": str(weights)}) if as_json else f"The weights are in {weights}.")


@app.command("evaluate", epilog="Example: sumo-adv transformer evaluate runs/scenes")
def evaluate(
    scenes: Scenes,
    weights: Annotated[Path | None, typer.Option(help="weights.npz of a training (default: the shipped ones).")] = None,
    as_json: Json = False,
) -> None:
    """Predict the held-out scenes, beside constant velocity and lane following."""
    from sumo_adv.transformer.dataset import HELD_OUT, load
    from sumo_adv.transformer.model import SHIPPED_WEIGHTS, read_weights
    from sumo_adv.transformer.train import evaluate as scores

    results = scores(read_weights(weights or SHIPPED_WEIGHTS), load(scenes, HELD_OUT))
    typer.echo(json.dumps([asdict(score) for score in results]) if as_json else table(results))


def table(scores: list[Score]) -> str:
    lines = [f"| {' | '.join(PREDICTOR_COLUMNS)} |", f"|{'---|' * len(PREDICTOR_COLUMNS)}"]
    for s in scores:
        figures = (f"{v:.2f}" for v in (s.min_ade, s.min_fde, s.miss_rate, s.ade, s.fde))
        lines.append(f"| {s.predictor} | {' | '.join(figures)} | {s.vehicles} |")
    return "\n".join(lines)


def _progress(what: str) -> Callable[..., None]:
    """Tells on stderr how far it is, every half a minute."""
    last = time.monotonic()

    def tell(done: int, total: int, loss: float | None = None) -> None:
        nonlocal last
        if time.monotonic() - last > PROGRESS_PERIOD_S or done == total:
            last = time.monotonic()
            typer.echo(f"{done} of {total} {what}{'' if loss is None else f', loss {loss:.3f}'}.", err=True)

    return tell


@contextmanager
def _going_on() -> Iterator[None]:
    """Ctrl-C ends with a sentence."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("sumo-adv: interrupted; what finished is kept, the same command goes on.", err=True)
        raise typer.Exit(1) from None
