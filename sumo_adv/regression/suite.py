"""Run all cases of a suite against one driver on worker processes, judge them, write a folder, and report.

OUT/regress.json    results and measurements; the file that --baseline takes
OUT/results.csv     one row per case, as in a batch: sumo-adv report OUT makes an index with the replays
OUT/runs/CASE/      the run of each case that reached its encounter
"""

from __future__ import annotations

import re
import tempfile
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
from sumo_adv.files import is_plain_name, json_text, scratch_prefix, sentences, write_text
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
CASE_DEADLINE_S = 300.0  # a case that takes longer is stuck; a case takes a few seconds
CASES_PER_WORKER = 200  # a worker process is replaced after this many cases
FORBIDDEN_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # XML 1.0, section 2.2
LINE_COLUMNS = ("case", "result", "level", "min TTC", "delta-v", "progress", "jerk", "time", "baseline", "")
BASELINE = LINE_COLUMNS.index("baseline")
PROPERTIES = (
    "level", "fault", "min_ttc", "min_distance", "delta_v", "progress", "jerk", "time_to_end", "attempts", "otherwise",
)  # fmt: skip
"""The measurements that JUnit gets as properties of a test case."""


@dataclass(frozen=True, slots=True)
class SuiteRun:
    """The result of a suite.

    Attributes:
        suite: The name of the suite.
        ego: The driver under test.
        cases: The cases, in order.
        waived: The cases that need not pass, by name.
    """

    suite: str
    ego: str
    cases: Sequence[JudgedCase]
    waived: Mapping[str, Waiver] = field(default_factory=dict)

    @property
    def counts(self) -> Mapping[CaseResult, int]:
        """The number of cases with each result."""
        counts = Counter(case.result for case in self.cases)
        return {result: counts[result] for result in CaseResult}

    def passed(self, *, allow_untested: bool) -> bool:
        """Return whether all cases pass, except those that are waived.

        Args:
            allow_untested: Whether cases that say nothing about the ego are allowed.
        """
        fine = {CaseResult.PASS, *(UNTESTED if allow_untested else ())}
        return all(case.result in fine or case.measured.case in self.waived for case in self.cases)

    def document(self) -> dict[str, Any]:
        """Return the content of ``regress.json``."""
        return {
            "schema": REGRESSION_SCHEMA, "suite": self.suite, "ego": self.ego, "versions": versions(),
            "counts": {str(result): many for result, many in self.counts.items()},
            "cases": [{**case.row(), "waived": self._waived(case)} for case in self.cases],
        }  # fmt: skip

    def _waived(self, case: JudgedCase) -> str | None:
        """Return the words of a case's waiver; None without one."""
        waiver = self.waived.get(case.measured.case)
        return None if waiver is None else waiver.words


def run_suite(
    cases: Sequence[KeptCase], suite: str, ego: str, out: Path, *, workers: int, force: bool, attempts: int = 1,
    baseline: Mapping[str, CaseMeasurements] | None = None, waived: Mapping[str, Waiver] | None = None,
    tell: Callable[[JudgedCase], None] = lambda case: None,
) -> SuiteRun:  # fmt: skip
    """Run each case against a driver, and write the results.

    Args:
        cases: The cases.
        suite: The name of the suite.
        ego: The driver under test.
        out: The folder to write.
        workers: The number of processes.
        force: Whether to replace an earlier folder.
        attempts: The maximum number of attempts of a case. With more than one, parameters near those of the case are
            tried.
        baseline: The measurements of an earlier run, by case; None without one.
        waived: The cases that need not pass, by name.
        tell: Called with each case when it is done.

    Raises:
        UsageError: The driver does not exist, a case lacks its baseline, two cases have the same name, or ``out`` is
            taken or cannot be written.
        SumoAdvError: No worker process starts.
    """
    make_ego(ego, {})
    known = baseline or {}
    lacking = [case.name for case in cases if case.expect.no_worse and case.name not in known]
    if lacking:
        advice = "give --baseline FILE" if baseline is None else "which the baseline lacks: rerun the baseline"
        raise UsageError(f"The case {lacking[0]} must be no worse than a baseline; {advice}.")
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
    """Run each case on worker processes.

    Args:
        cases: The cases.
        ego: The driver under test.
        runs: The folder for the folders of the runs; it is created.
        workers: The number of processes.
        attempts: The maximum number of attempts of a case.
        tell: Called with the measurements of each case.

    Raises:
        SumoAdvError: No worker process starts.
    """

    def finished(job: Any, done: Done) -> None:
        tell(measured_of(done.row or {}))

    def failed(job: Any, why: str, text: str) -> Done:
        return Done(job.id, asdict(CaseMeasurements(job.id, ego, broken=why)), text=text)

    runs.mkdir()
    jobs = [CaseJob(case.name, case.folder.absolute()) for case in cases]
    setup, pace = (
        SuiteSetup(runs.absolute(), ego, attempts),
        WorkerPace(workers, CASE_DEADLINE_S * max(1, attempts // 4), CASES_PER_WORKER),
    )
    with (
        tempfile.TemporaryDirectory(prefix=scratch_prefix(), ignore_cleanup_errors=True) as scratch,
        closing(LocalWorkers(setup, pace, Path(scratch), failed, Stop(), CaseRunner)) as pool,
    ):
        pool.run(jobs, finished)


def read_results(path: Path) -> dict[str, Any]:
    """Read the JSON file of a suite's run.

    Args:
        path: The file, or its folder.

    Raises:
        UsageError: The file cannot be read.
    """
    file = path / REGRESSION_FILE if path.is_dir() else path
    try:
        document = read_json(file)
        if document["schema"] != REGRESSION_SCHEMA:
            raise UsageError(f"{file} has schema {document['schema']}; this program reads {REGRESSION_SCHEMA}.")
        rows = list(document["cases"])
        if wrong := [name for name in (measured_of(row).case for row in rows) if not is_plain_name(name)]:
            raise UsageError(f"{file} names the case {wrong[0]!r}, which is not a folder's name; rerun the suite.")
        return {**document, "cases": rows}
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"{file} has a bad '{dotted(first['loc'])}' ({first['msg']}); rerun the suite.") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{file} is not what sumo-adv regress writes ({error}); give its {REGRESSION_FILE}."
        ) from error


def read_baseline(path: Path) -> dict[str, CaseMeasurements]:
    """Read the measurements of another run of the suite, by case.

    Args:
        path: The JSON file, or its folder.

    Raises:
        UsageError: The file cannot be read.
    """
    return {measured.case: measured for measured in map(measured_of, read_results(path)["cases"])}


def write_junit(file: Path, run: SuiteRun, *, allow_untested: bool) -> None:
    """Write the JUnit file, whole or not at all.

    Args:
        file: The path of the file.
        run: The result of the suite.
        allow_untested: Whether cases that say nothing about the ego are allowed.

    Raises:
        UsageError: The file cannot be written.
        SumoAdvError: The disk fails.
    """
    with sentences(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, junit(run, allow_untested=allow_untested))


def junit(run: SuiteRun, *, allow_untested: bool) -> str:
    """Return the text of the JUnit file.

    A case that says nothing about the ego is a failure, or skipped if such cases are allowed. A case that is waived and
    does not pass is skipped.

    Args:
        run: The result of the suite.
        allow_untested: Whether cases that say nothing about the ego are allowed.
    """
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
    """Return the element inside the test case; empty if the case passes."""
    if case.result is CaseResult.PASS:
        return ""
    if waived:
        return "skipped"
    if case.result is CaseResult.ERROR:
        return "error"
    return "skipped" if allow_untested and case.result is not CaseResult.FAIL else "failure"


def _clean(text: str) -> str:
    """Replace characters that XML forbids."""
    return FORBIDDEN_IN_XML.sub("\ufffd", text)


def lines(run: SuiteRun) -> list[str]:
    """Return one line for each case, and a summary. The baseline's column is shown only if there is a baseline.

    Args:
        run: The result of the suite.
    """
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
    """Return the columns of a case."""
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
    """Format a value with its unit; - if it is None."""
    return "-" if value is None else f"{value:.{digits}f} {unit}"


def _before(m: CaseMeasurements | None) -> str:
    """Format the result in the baseline."""
    if m is None or m.broken:
        return "-"
    return f"{m.level}, {_number(m.min_ttc, 's')}" if not m.collided else f"{m.level}, {_number(m.delta_v, 'm/s')}"
