"""The motion predictor of the row ``transformer``: scenes to learn from, training (extra ``train``) and evaluation.

    python benchmarks/transformer.py data --out runs/scenes
    python benchmarks/transformer.py train runs/scenes --out runs/transformer
    python benchmarks/transformer.py evaluate runs/scenes --weights runs/transformer/weights.npz

``data`` and ``train`` go on where the folder stands.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

from transformer_records import make_from_records
from transformer_scenes import HELD_OUT, TRAIN, load, make
from transformer_training import Score, evaluate, train

from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import sentences
from sumo_adv.transformer.model import SHIPPED_WEIGHTS, read_weights

RECORDS = "womd:"
PROGRESS_INTERVAL_S = 30.0
FIGURES = ("predictor", "minADE [m]", "minFDE [m]", "miss rate", "ADE [m]", "FDE [m]", "vehicles")


def main(words: list[str] | None = None) -> None:
    args = _parser().parse_args(words)
    try:
        if args.command == "evaluate":
            print(table(evaluate(read_weights(args.weights), load(args.scenes, HELD_OUT))))
            return
        with sentences(args.out):
            args.out.mkdir(parents=True, exist_ok=True)
            print(_data(args) if args.command == "data" else _train(args))
    except SumoAdvError as error:
        sys.exit(f"transformer: {error}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Make scenes, train and evaluate the motion predictor.")
    commands = parser.add_subparsers(dest="command", required=True)
    data = commands.add_parser("data", help="scenes to train on and held-out ones")
    data.add_argument("source", nargs="?", default="sumo", help="sumo, or womd:FOLDER with Waymo records")
    data.add_argument("--out", type=Path, default=Path("runs/scenes"))
    data.add_argument("--seed", type=int, default=0, help="of networks, traffic and the choice of scenes")
    data.add_argument("--runs", type=int, default=200, help="runs of SUMO to train on; an eighth as many are held out")
    training = commands.add_parser("train", help="JAX, on one thread of the CPU")
    training.add_argument("scenes", type=Path, help="the folder that data wrote")
    training.add_argument("--out", type=Path, default=Path("runs/transformer"))
    training.add_argument("--seed", type=int, default=0, help="of the first weights and the order of scenes")
    training.add_argument("--epochs", type=int, default=5, help="how often each scene is seen")
    training.add_argument("--steps", type=int, help="end after these steps (default: after the epochs)")
    evaluation = commands.add_parser("evaluate", help="beside constant velocity and lane following")
    evaluation.add_argument("scenes", type=Path, help="the folder that data wrote")
    evaluation.add_argument("--weights", type=Path, default=SHIPPED_WEIGHTS, help="weights.npz (default: shipped)")
    return parser


def _data(args: argparse.Namespace) -> str:
    progress = _progress("runs")
    if args.source.startswith(RECORDS):
        made = make_from_records(Path(args.source.removeprefix(RECORDS)), args.out, progress)
    elif args.source == "sumo":
        made = make(args.out, seed=args.seed, runs=args.runs, progress=progress)
    else:
        raise UsageError(f"There is no source '{args.source}' of scenes; give sumo or womd:FOLDER.")
    return f"{made} files of scenes in {args.out}."


def _train(args: argparse.Namespace) -> str:
    weights = train(
        load(args.scenes, TRAIN), args.out, seed=args.seed, epochs=args.epochs, steps=args.steps,
        progress=_progress("steps"),
    )  # fmt: skip
    return f"The weights are in {weights}."


def table(scores: list[Score]) -> str:
    lines = [f"| {' | '.join(FIGURES)} |", f"|{'---|' * len(FIGURES)}"]
    for s in scores:
        figures = (f"{v:.2f}" for v in (s.min_ade, s.min_fde, s.miss_rate, s.ade, s.fde))
        lines.append(f"| {s.predictor} | {' | '.join(figures)} | {s.vehicles} |")
    return "\n".join(lines)


def _progress(what: str) -> Callable[..., None]:
    """Tells on stderr how far it is, every half a minute."""
    last = time.monotonic()

    def tell(done: int, total: int, loss: float | None = None) -> None:
        nonlocal last
        if time.monotonic() - last > PROGRESS_INTERVAL_S or done == total:
            last = time.monotonic()
            print(f"{done} of {total} {what}{'' if loss is None else f', loss {loss:.3f}'}.", file=sys.stderr)

    return tell


if __name__ == "__main__":
    main()
