"""From a record to a folder that ``run`` takes, kept in the user's cache so that nothing is converted twice.

The key is the SHA-256 of the record's bytes with the program's version and the sources of this package: a changed
converter converts again. A folder is written beside its place and moved there whole.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any

from sumo_adv import __version__
from sumo_adv.files import user_folder
from sumo_adv.parsing import parse_json
from sumo_adv.womd.record import Record
from sumo_adv.womd.scene import SCENARIO, write_scene

REPORT, PICTURE = "fidelity.json", "fidelity.png"
MOST_KEPT = 300  # conversions in the cache; the oldest go first


@dataclass(frozen=True, slots=True)
class Conversion:
    """Where a record's files are, its fidelity report, and whether it had been converted before."""

    folder: Path
    report: Mapping[str, Any]
    cached: bool

    @property
    def scenario(self) -> Path:
        """The scenario file."""
        return self.folder / SCENARIO


def convert_record(record: Record, folder: Path, *, traffic: bool) -> dict[str, Any]:
    """Network, scenario, tracks, routes and fidelity report of a record into ``folder``; gives the report.

    traffic: also try random traffic. Raises SumoAdvError if the record cannot be converted.
    """
    from sumo_adv.womd.fidelity import measure
    from sumo_adv.womd.network import convert_network
    from sumo_adv.womd.picture import draw_fidelity
    from sumo_adv.womd.sampling import evenly_sampled
    from sumo_adv.womd.sumonet import read_net

    began, cpu = perf_counter(), sum(os.times()[:4])  # our own and our children's, netconvert being one
    record, sampling = evenly_sampled(record)
    converted = convert_network(record, folder)
    seconds = {"network": converted.seconds, "network_cpu": round(sum(os.times()[:4]) - cpu, 3)}
    net = read_net(converted.path)
    fidelity = measure(record, net, converted)
    write_scene(record, net, fidelity.matched, folder)
    draw_fidelity(folder / PICTURE, record, net, fidelity)
    seconds["all"] = perf_counter() - began
    scenario = {
        "ego": record.tracks[record.sdc].id, "objects_of_interest": list(record.objects_of_interest),
        "to_predict": [record.tracks[i].id for i in record.to_predict],
    }  # fmt: skip
    report = {
        **fidelity.report, "scenario": scenario, "sampling": {**asdict(sampling), "note": sampling.sentence},
        "traffic": None, "seconds": seconds,
    }  # fmt: skip
    return _with_traffic(folder, report) if traffic else _written(folder, report)


def _with_traffic(folder: Path, report: dict[str, Any]) -> dict[str, Any]:
    from sumo_adv.womd.scene import NETWORK
    from sumo_adv.womd.traffic import random_traffic

    return _written(folder, {**report, "traffic": random_traffic(folder / NETWORK)})


def _written(folder: Path, report: dict[str, Any]) -> dict[str, Any]:
    unfinished = folder / f"{REPORT}.part"
    unfinished.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    unfinished.replace(folder / REPORT)
    return report


@contextlib.contextmanager
def conversion(record: Record, *, traffic: bool, cache: Path | None = None) -> Iterator[Conversion]:
    """The conversion of a record, from the cache (default: the user's) or made now.

    Where the cache cannot be written, its folder lives as long as the context. Raises SumoAdvError like
    :func:`convert_record`.
    """
    place = (cache or cache_folder()) / _key(record.content) / record.scenario_id
    report = _known(place)
    if report is not None:
        if traffic and report.get("traffic") is None:
            report = _with_traffic(place, report)
        with contextlib.suppress(OSError):
            os.utime(place.parent)
        yield Conversion(place, report, cached=True)
        return
    with contextlib.ExitStack() as stack:
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            kept, stage = True, Path(stack.enter_context(tempfile.TemporaryDirectory(dir=place.parent)))
        except OSError:
            kept, stage = False, Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sumo_adv-")))
        made = stage / record.scenario_id
        made.mkdir()
        report = convert_record(record, made, traffic=traffic)
        if kept:
            with contextlib.suppress(OSError):  # another process was faster: its file is the same
                made.rename(place)
            made = place
            _trim(place.parent.parent)
        yield Conversion(made, report, cached=False)


def _known(place: Path) -> dict[str, Any] | None:
    """The report of a whole conversion at ``place``, or None."""
    try:
        return dict(parse_json((place / REPORT).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _trim(cache: Path) -> None:
    """Remove the oldest conversions beyond ``MOST_KEPT``."""
    with contextlib.suppress(OSError):
        kept = sorted((p for p in cache.iterdir() if p.is_dir()), key=lambda p: p.stat().st_mtime)
        for old in kept[:-MOST_KEPT]:
            shutil.rmtree(old, ignore_errors=True)


def _key(content: str) -> str:
    return hashlib.sha256(f"{content} {__version__} {_sources()}".encode()).hexdigest()[:32]


@lru_cache(maxsize=1)
def _sources() -> str:
    """A hash of this package's own sources."""
    folder = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def cache_folder(
    environ: Mapping[str, str] = os.environ, platform: str = sys.platform, home: Path | None = None
) -> Path:
    """Where conversions are kept, in the user's cache folder (:func:`~sumo_adv.files.user_folder`)."""
    return user_folder("cache", environ, platform, home) / "womd"
