"""What is read, drawn and exported of a run with a support: all adversaries are there."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from page_samples import Visit, chromium
from several_samples import COLLIDER, SUPPORT, pinch, pinched

import sumo_adv
from sumo_adv.report.encounter_figure import SUPPORT_COLOUR
from sumo_adv.report.export import Variant
from sumo_adv.report.export.openscenario import openscenario
from sumo_adv.report.export.piece import ExportedRun, read_piece
from sumo_adv.report.export.sumo import table
from sumo_adv.report.figures import draw_paper, read_story
from sumo_adv.report.page import make_page


@pytest.fixture(scope="module")
def piece() -> ExportedRun:
    return read_piece(pinched())


def test_an_attempt_of_the_result_has_its_supports() -> None:
    (attempt,) = sumo_adv.load(pinched()).outcome.attempts
    assert (attempt.adversary, attempt.composition) == (COLLIDER, "Pinch")
    (support,) = attempt.supports
    assert (support.id, support.role, support.intent, support.mode) == (
        SUPPORT, "block_right", "Escape Block Right", "beside"
    )  # fmt: skip
    assert support.parameters == pinch(COLLIDER, SUPPORT).supports[0].parameters


def test_a_figure_draws_the_support_with_and_without_the_attack() -> None:
    story = read_story(pinched())
    assert story.intent == "Pinch" and story.raw is not None
    for scene in (story.raw, story.attacked):
        assert [t.id for t in scene.supports] == [SUPPORT]
        assert SUPPORT not in {t.id for t in scene.others}
    figure = draw_paper(story)
    for axes in figure.axes:
        assert [line.get_color() for line in axes.lines].count(SUPPORT_COLOUR) == 1
    assert "support" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert f"Pinch by {COLLIDER} + {SUPPORT}: collision" in figure.axes[1].get_title(loc="left")


def test_openscenario_names_the_support_and_starts_all_attacks_together(piece: ExportedRun) -> None:
    root = ElementTree.fromstring(openscenario(piece, Variant.FREE_EGO))
    properties = {p.get("name"): p.get("value") for p in root.iter("Property")}
    assert (properties["sumo_adv_adversary"], properties["sumo_adv_support_1"]) == (COLLIDER, SUPPORT)
    triggers = {
        name: ElementTree.tostring(trigger)
        for name in (COLLIDER, SUPPORT)
        for event in root.iter("Event") if event.get("name") == f"{name} attacks"
        for trigger in event.iter("StartTrigger")
    }  # fmt: skip
    assert set(triggers) == {COLLIDER, SUPPORT} and triggers[COLLIDER] == triggers[SUPPORT]


def test_the_table_says_of_both_that_the_attack_drives_them(piece: ExportedRun) -> None:
    rows = list(csv.DictReader(io.StringIO(table(piece))))
    assert {row["vehicle"] for row in rows if row["driven_by_attack"] == "1"} == {COLLIDER, SUPPORT}


def test_the_page_names_all_adversaries_and_paints_the_support(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(make_page(pinched()), encoding="utf-8")
    with chromium() as browser, Visit(browser, file) as visit:
        page = visit.page
        assert page.locator("#title").inner_text().endswith(f"Pinch by {COLLIDER} + {SUPPORT}")
        names = page.evaluate("window.replay.then((p) => p.scene.attempts.map((a) => a.supports.map((v) => v.id)))")
        assert names == [[SUPPORT], [SUPPORT]]  # attacked and unattacked
        colours = page.evaluate(PIXELS)
        assert np.abs(np.array(colours) - (0xE6, 0x9F, 0x00)).sum(axis=1).min() == 0


PIXELS = """() => { const c = document.getElementById("map");
    const d = new Uint32Array(c.getContext("2d").getImageData(0, 0, c.width, c.height).data.buffer);
    return [...new Set(d)].map((v) => [v & 255, (v >> 8) & 255, (v >> 16) & 255]); }"""
