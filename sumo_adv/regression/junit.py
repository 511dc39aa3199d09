"""The results of a suite as JUnit XML, the format that build servers show."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from sumo_adv.files import sentences, write_text
from sumo_adv.regression.measured import Judged, Result
from sumo_adv.regression.suite import SuiteRun

FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # XML 1.0, section 2.2


def write_junit(file: Path, run: SuiteRun, *, allow_untested: bool) -> None:
    """Write the file, whole or not at all. Raises UsageError, SumoAdvError."""
    with sentences(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, junit(run, allow_untested=allow_untested))


def junit(run: SuiteRun, *, allow_untested: bool) -> str:
    """The text. A case that says nothing about the ego is a failure, or skipped if such cases are allowed."""
    kinds = [_kind(case, allow_untested) for case in run.cases]
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
        if kind:
            about = {"message": _clean(case.sentence)} | ({"type": str(case.result)} if kind != "skipped" else {})
            ElementTree.SubElement(test, kind, about)
    whole = ElementTree.Element("testsuites")
    whole.append(suite)
    ElementTree.indent(whole)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(whole, encoding="unicode") + "\n"


def _kind(case: Judged, allow_untested: bool) -> str:
    """The element inside the test case; empty if it passes."""
    if case.result is Result.PASS:
        return ""
    if case.result is Result.ERROR:
        return "error"
    return "skipped" if allow_untested and case.result is not Result.FAIL else "failure"


def _clean(text: str) -> str:
    """Without characters that XML cannot hold."""
    return FORBIDDEN.sub("\ufffd", text)
