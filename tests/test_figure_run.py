"""Figures and films of a run: every kind of file, the same bytes again, and one sentence where there is none."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from run_samples import run_folder
from test_figure import CUT, EGO, LANES, OTHER, RAW
from typer.testing import CliRunner

from sumo_adv.cli.main import app
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.report.figures import FigureScene, Story, draw_paper, read_story, save, write_film

OUTCOME: Mapping[str, Any] = {"collided": False, "min_ttc": 0.7}
WITH, WITHOUT = FigureScene(EGO, CUT, [OTHER]), FigureScene(EGO, RAW, [OTHER])
STORY = Story("made up", "Aggressive $Cut-in$", LANES, WITH, WITHOUT, 11.0, 12.0, 12.5, OUTCOME)


def figure(*arguments: str | Path) -> tuple[int, SumoAdvError | None]:
    """Exit status and our error of the command in this process."""
    done = CliRunner().invoke(app, ["figure", *map(str, arguments)])
    return done.exit_code, done.exception if isinstance(done.exception, SumoAdvError) else None


@pytest.mark.parametrize(("kind", "begins"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF-")])
def test_a_run_is_drawn_in_every_format(tmp_path: Path, kind: str, begins: bytes) -> None:
    target = tmp_path / "deep" / f"a.{kind}"
    assert figure(run_folder("crossing"), "--out", target) == (0, None)
    assert target.read_bytes().startswith(begins)
    assert [p.name for p in target.parent.iterdir()] == [f"a.{kind}"]


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_the_same_story_gives_the_same_bytes(tmp_path: Path, kind: str) -> None:
    for name in ("one", "two"):
        save(draw_paper(STORY), tmp_path / name, kind)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_the_story_is_what_the_outcome_says() -> None:
    story = read_story(run_folder("crossing"))
    assert story.raw is not None
    assert story.attacked.ego.id == story.raw.ego.id == "ego"
    assert story.attacked.adversary.id == story.raw.adversary.id == "turning"
    contact = story.outcome["contact_time"]
    assert story.collided is (contact is not None)
    assert story.trigger < story.decisive <= story.end <= story.decisive + 1.5
    assert len(story.lanes) > 8
    left, bottom, width, height = story.view(widest=4.0)
    for track in story.attacked.pair():
        part = track.between(story.trigger, story.end)
        assert (part.x > left).all() and (part.x < left + width).all()
        assert (part.y > bottom).all() and (part.y < bottom + height).all()
    assert 1.0 <= width / height <= 4.0 + 1e-9


def test_both_maps_have_one_scale_and_their_words() -> None:
    picture = draw_paper(STORY)
    before, after = picture.axes
    assert before.get_xlim() == after.get_xlim() and before.get_ylim() == after.get_ylim()
    assert before.get_title(loc="left") == "(a) Unattacked"
    assert after.get_title(loc="left") == "(b) Aggressive $Cut-in$ by bv: min TTC 0.70 s"
    assert {text.get_text() for text in after.texts} >= {"0", "1", "10 m"}  # marks of time since the trigger
    alone = Story(
        STORY.name, STORY.intent, LANES, STORY.attacked, None, STORY.trigger, STORY.decisive, STORY.end, OUTCOME
    )
    assert len(draw_paper(alone).axes) == 1


def test_the_figure_is_as_wide_as_a_page(tmp_path: Path) -> None:
    save(draw_paper(STORY), tmp_path / "a", "png")
    width, _ = struct.unpack(">II", (tmp_path / "a").read_bytes()[16:24])
    assert width == 2148  # 7.16 inches at 300 dots


def test_a_gif_shows_every_step(tmp_path: Path) -> None:
    write_film(STORY, tmp_path / "a.gif", "gif")
    with Image.open(tmp_path / "a.gif") as film:
        shown = sum(_duration(film, k) for k in range(film.n_frames))
        assert film.size[0] == 800
        assert film.n_frames >= 25  # 10 .. 12.5 s; the standing end may be one frame
    assert shown == pytest.approx(3600, abs=10)  # 26 steps and 10 for the end, 100 ms each
    assert [p.name for p in tmp_path.iterdir()] == ["a.gif"]


def _duration(film: Image.Image, frame: int) -> float:
    film.seek(frame)
    return float(film.info["duration"])


def test_an_mp4_shows_every_step(tmp_path: Path) -> None:
    if shutil.which("ffmpeg") is None:
        pytest.skip("ffmpeg is not installed")
    write_film(STORY, tmp_path / "a.mp4", "mp4")
    log = subprocess.run(
        ["ffmpeg", "-hide_banner", "-i", str(tmp_path / "a.mp4"), "-f", "null", "-"], capture_output=True, text=True,
        check=True,
    ).stderr  # fmt: skip
    assert re.findall(r"frame=\s*(\d+)", log)[-1] == "36"
    assert "yuv420p" in log


def test_an_mp4_without_ffmpeg_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match="apt-get install ffmpeg"):
        write_film(STORY, tmp_path / "a.mp4", "mp4")
    assert list(tmp_path.iterdir()) == []


def test_wrong_use_is_one_sentence(tmp_path: Path) -> None:
    folder = run_folder("crossing")
    (tmp_path / "a.png").write_bytes(b"")
    for arguments, says in (
        ((folder, "--out", tmp_path / "a.bmp"), "has an ending that cannot be drawn"),
        ((folder, "--out", tmp_path / "a.png"), "already exists"),
        ((tmp_path, "--out", tmp_path / "b.png"), "holds no outcome.json"),
    ):
        _, error = figure(*arguments)
        assert isinstance(error, UsageError) and says in str(error)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
