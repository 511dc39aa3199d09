"""A system without SUMO's system libraries, played by a libsumo that fails as the real one does there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LACKS = "libX11.so.6: cannot open shared object file: No such file or directory"


@pytest.mark.parametrize(
    ("reason", "remedy"), [(LACKS, "apt-get install libx11-6 libxext6"), ("half of it is gone", "pip install")]
)
def test_a_libsumo_that_does_not_load_says_what_to_install(tmp_path: Path, reason: str, remedy: str) -> None:
    (tmp_path / "libsumo.py").write_text(f"raise ImportError({reason!r})\n")
    done = subprocess.run(
        [sys.executable, "-m", "sumo_adv", "run", "motorway_cut_in_left", "--memory", "bank.sqlite"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert f"does not load ({reason})" in done.stderr
    assert remedy in done.stderr
    assert "Traceback" not in done.stderr


def test_the_tests_say_so_too_before_any_of_them_runs(tmp_path: Path) -> None:
    (tmp_path / "libsumo.py").write_text(f"raise ImportError({LACKS!r})\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"}, capture_output=True, text=True,
        check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert f"does not load ({LACKS}): install its system libraries (Debian: apt-get install libx11-6" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_packages_are_the_same_wherever_they_are_named() -> None:
    from sumo_adv.simulation.programs import SYSTEM_LIBRARIES

    for name in ("docs/first_hour.md", ".ci/run", "docker/Dockerfile"):
        words = " ".join((ROOT / name).read_text(encoding="utf-8").replace("\\", " ").split())
        for package in SYSTEM_LIBRARIES.split():
            assert package in words, f"{package} is not named in {name}"
