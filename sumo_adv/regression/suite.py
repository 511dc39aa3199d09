"""All cases of a suite against one driver: run on worker processes, judged, kept in a folder, and told.

OUT/regress.json    results and measurements; the file that --baseline takes
OUT/results.csv     a row a case, as a batch has it: sumo-adv report OUT makes an index with the replays
OUT/runs/CASE/      the run of each case that came to its encounter
"""

from __future__ import annotations

import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sumo_adv.campaigns.local import LocalWorkers, Stop, WorkerPace
from sumo_adv.campaigns.results import Done, Row, read_row, write_csv
from sumo_adv.drivers import make_ego
from sumo_adv.errors import UsageError
from sumo_adv.files import is_plain_name, json_text, sentences, write_text
from sumo_adv.parsing import dotted, read_json
from sumo_adv.regression.case import KeptCase
from sumo_adv.regression.runner import (
    UNTESTED,
    CaseJob,
    CaseMeasurements,
    CaseResult,
    CaseRunner,
    JudgedCase,
    SuiteSetup,
    judged,
    measured_of,
)
from sumo_adv.regression.waivers import Waiver
from sumo_adv.report.outcome import versions
from sumo_adv.report.staging import staged

REGRESSION_SCHEMA = 1
REGRESSION_FILE = "regress.json"
CASE_DEADLINE_S = 300.0  # s after which a case is held to be stuck; one takes a few seconds
CASES_PER_WORKER = 200  # cases after which a worker process is replaced
FORBIDDEN_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # XML 1.0, section 2.2
LINE_COLUMNS = ("case", "result", "level", "min TTC", "delta-v", "progress", "jerk", "time", "baseline", "")
BASELINE = LINE_COLUMNS.index("baseline")
PROPERTIES = (
    "level", "min_ttc", "min_distance", "delta_v", "progress", "jerk", "time_to_end", "attempts", "otherwise",
)  # fmt: skip
"""Measurements that JUnit has as properties of a test case."""


@dataclass(frozen=True, slots=True)
class SuiteRun:
    """What a suite came to: its cases in order. ``waived``: cases that need not pass, by name."""

    suite: str
    ego: str
    cases: Sequence[JudgedCase]
    waived: Mapping[str, Waiver] = field(default_factory=dict)

    @property
    def counts(self) -> Mapping[CaseResult, int]:
        counts = Counter(case.result for case in self.cases)
        return {result: counts[result] for result in CaseResult}

    def passed(self, *, allow_untested: bool) -> bool:
        """Whether all cases pass but those that are waived, leaving out those that say nothing about the ego if they
        are allowed."""
        fine = {CaseResult.PASS, *(UNTESTED if allow_untested else ())}
        return all(case.result in fine or case.measured.case in self.waived for case in self.cases)

    def document(self) -> dict[str, Any]:
        return {
            "schema": REGRESSION_SCHEMA, "suite": self.suite, "ego": self.ego, "versions": versions(),
            "counts": {str(result): many for result, many in self.counts.items()},
            "cases": [{**case.row(), "waived": self._waived(case)} for case in self.cases],
        }  # fmt: skip

    def _waived(self, case: JudgedCase) -> str | None:
        waiver = self.waived.get(case.measured.case)
        return None if waiver is None else waiver.words


def run_suite(
    cases: Sequence[KeptCase], suite: str, ego: str, out: Path, *, workers: int, force: bool, attempts: int = 1,
    baseline: Mapping[str, CaseMeasurements] | None = None, waived: Mapping[str, Waiver] | None = None,
    tell: Callable[[JudgedCase], None] = lambda case: None,
) -> SuiteRun:  # fmt: skip
    """Run each case against ``ego``, and write ``out``.

    attempts: that a case may take; with more than one, numbers near those of the case are tried. waived: cases that
    need not pass. tell: called with each case when it is done.

    Raises:
        UsageError: no such ego, a case without its baseline, or ``out`` is taken or cannot be written.
        SumoAdvError: no worker process starts.
    """
    make_ego(ego, {})
    known = baseline or {}
    lacking = [case.name for case in cases if case.expect.no_worse and case.name not in known]
    if lacking:
        advice = "give --baseline FILE" if baseline is None else "which the baseline lacks: run the baseline again"
        raise UsageError(f"The case {lacking[0]} is to be no worse than a baseline; {advice}.")
    twice = [name for name, times in Counter(case.name for case in cases).items() if times > 1]
    if twice:
        raise UsageError(f"Two cases have the name {twice[0]}: rename the folder of one.")
    results: dict[str, JudgedCase] = {}
    by_name = {case.name: case for case in cases}

    def finished(measured: CaseMeasurements) -> None:
        name = measured.case
        results[name] = judged(by_name[name], measured, known.get(name))
        tell(results[name])

    with staged(out, force=force) as folder, sentences(out):
        runs = folder.stage / "runs"
        measure_cases(cases, ego, runs, workers, attempts, finished)
        whole = SuiteRun(suite, ego, [results[case.name] for case in cases], waived or {})
        write_text(folder.stage / REGRESSION_FILE, json_text(whole.document(), 2))
        rows: list[Row] = [row for run in sorted(runs.iterdir()) if (row := read_row(run)) is not None]
        write_csv(folder.stage / "results.csv", rows, [])
        folder.keep(force=force)
    return whole


def measure_cases(
    cases: Sequence[KeptCase],
    ego: str,
    runs: Path,
    workers: int,
    attempts: int,
    tell: Callable[[CaseMeasurements], None],
) -> None:
    """Run each case on worker processes. runs: a folder that is made for the folders of the runs; tell: called with
    what each case came to. Raises SumoAdvError: no worker process starts."""

    def finished(job: Any, done: Done) -> None:
        tell(measured_of(done.row or {}))

    def failed(job: Any, why: str, text: str) -> Done:
        return Done(job.id, asdict(CaseMeasurements(job.id, ego, broken=why)), text=text)

    scratch = runs.parent / ".workers"
    runs.mkdir()
    scratch.mkdir()
    jobs = [CaseJob(case.name, case.folder.absolute()) for case in cases]
    setup, pace = (
        SuiteSetup(runs.absolute(), ego, attempts),
        WorkerPace(workers, CASE_DEADLINE_S * max(1, attempts // 4), CASES_PER_WORKER),
    )
    with closing(LocalWorkers(setup, pace, scratch.absolute(), failed, Stop(), CaseRunner)) as pool:
        pool.run(jobs, finished)
    shutil.rmtree(scratch, ignore_errors=True)


def read_results(path: Path) -> dict[str, Any]:
    """The JSON file of a suite's run, or that in its folder. Raises UsageError."""
    file = path / REGRESSION_FILE if path.is_dir() else path
    try:
        document = read_json(file)
        if document["schema"] != REGRESSION_SCHEMA:
            raise UsageError(f"{file} has schema {document['schema']}; this program reads {REGRESSION_SCHEMA}.")
        rows = list(document["cases"])
        if wrong := [name for name in (measured_of(row).case for row in rows) if not is_plain_name(name)]:
            raise UsageError(f"{file} names the case {wrong[0]!r}, which is no folder's name; run the suite again.")
        return {**document, "cases": rows}
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"{file} has a bad '{dotted(first['loc'])}' ({first['msg']}); run the suite again.") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{file} is not what sumo-adv regress writes ({error}); give its {REGRESSION_FILE}."
        ) from error


def read_baseline(path: Path) -> dict[str, CaseMeasurements]:
    """The measurements of another run of the suite, by case. Raises UsageError."""
    return {measured.case: measured for measured in map(measured_of, read_results(path)["cases"])}


def write_junit(file: Path, run: SuiteRun, *, allow_untested: bool) -> None:
    """Write the file, whole or not at all. Raises UsageError, SumoAdvError."""
    with sentences(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, junit(run, allow_untested=allow_untested))


def junit(run: SuiteRun, *, allow_untested: bool) -> str:
    """The text. A case that says nothing about the ego is a failure, or skipped if such cases are allowed. One that is
    waived and does not pass is skipped."""
    kinds = [_kind(case, allow_untested, case.measured.case in run.waived) for case in run.cases]
    suite = ElementTree.Element("testsuite", {
        "name": _clean(run.suite), "tests": str(len(run.cases)), "failures": str(kinds.count("failure")),
        "errors": str(kinds.count("error")), "skipped": str(kinds.count("skipped")),
        "time": f"{sum(case.measured.seconds for case in run.cases):.3f}",
    })  # fmt: skip
    for case, kind in zip(run.cases, kinds, strict=True):
        m = case.measured
        test = ElementTree.SubElement(suite, "testcase", {
            "classname": _clean(f"{run.suite}.{run.ego}"), "name": _clean(m.case), "time": f"{m.seconds:.3f}",
        })  # fmt: skip
        measured = ElementTree.SubElement(test, "properties")
        for name in PROPERTIES:
            value = getattr(m, name)
            ElementTree.SubElement(measured, "property", {
                "name": name, "value": "" if value is None else _clean(str(value)),
            })  # fmt: skip
        if kind:
            waiver = run.waived.get(m.case)
            words = case.sentence if waiver is None else f"{waiver.words} ({case.result}: {case.sentence})"
            about = {"message": _clean(words)} | ({"type": str(case.result)} if kind != "skipped" else {})
            ElementTree.SubElement(test, kind, about)
    whole = ElementTree.Element("testsuites")
    whole.append(suite)
    ElementTree.indent(whole)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(whole, encoding="unicode") + "\n"


def _kind(case: JudgedCase, allow_untested: bool, waived: bool) -> str:
    """The element inside the test case; empty if it passes."""
    if case.result is CaseResult.PASS:
        return ""
    if waived:
        return "skipped"
    if case.result is CaseResult.ERROR:
        return "error"
    return "skipped" if allow_untested and case.result is not CaseResult.FAIL else "failure"


def _clean(text: str) -> str:
    return FORBIDDEN_IN_XML.sub("\ufffd", text)


def lines(run: SuiteRun) -> list[str]:
    """A line a case, and a sum; the baseline's column only if there is a baseline."""
    rows = [_row(case, run.waived.get(case.measured.case)) for case in run.cases]
    shown = [k for k in range(len(LINE_COLUMNS)) if k != BASELINE or any(case.before for case in run.cases)]
    widths = [max(len(row[k]) for row in (LINE_COLUMNS, *rows)) for k in range(len(LINE_COLUMNS))]
    table = ["  ".join(row[k].ljust(widths[k]) for k in shown).rstrip() for row in (LINE_COLUMNS, *rows)]
    counts = [f"{many} {result}" for result, many in run.counts.items() if many or result is CaseResult.PASS]
    cases = f"{len(run.cases)} case{'s' * (len(run.cases) != 1)}"
    waived = [case for case in run.cases if case.measured.case in run.waived and case.result is not CaseResult.PASS]
    excused = f" {len(waived)} of them {'is' if len(waived) == 1 else 'are'} waived." if waived else ""
    return [*table, "", f"{cases} of {run.suite} against {run.ego}: {', '.join(counts)}.{excused}"]


def _row(case: JudgedCase, waiver: Waiver | None) -> Sequence[str]:
    m = case.measured
    figures: Sequence[str] = ("-",) * 6
    if case.result not in (CaseResult.NO_ENCOUNTER, CaseResult.ERROR):
        figures = (
            m.level, _number(m.min_ttc, "s"), _number(m.delta_v, "m/s"), _number(m.progress, "m", 0),
            _number(m.jerk, "m/s3", 0), _number(m.time_to_end, "s", 1),
        )  # fmt: skip
    excuse = waiver.words if waiver is not None and case.result is not CaseResult.PASS else ""
    words = " ".join(filter(None, (excuse, case.sentence.split("\n")[0])))
    return (m.case, str(case.result), *figures, _before(case.before), words)


def _number(value: float | None, unit: str, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}"


def _before(m: CaseMeasurements | None) -> str:
    if m is None or m.broken:
        return "-"
    return f"{m.level}, {_number(m.min_ttc, 's')}" if not m.collided else f"{m.level}, {_number(m.delta_v, 'm/s')}"
