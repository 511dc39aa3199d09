"""The image, built and run by what this machine has for it: ``docker/check.py``, which says what it could not check."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest
from cli_samples import ROOT

LACKING = [name for name in ("buildah", "debootstrap") if shutil.which(name) is None]


@pytest.mark.soak
@pytest.mark.skipif(bool(LACKING), reason=f"not installed: {', '.join(LACKING)} (on Debian: apt-get install)")
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="docker/check.py wants root")
def test_the_image_is_built_and_runs() -> None:
    done = subprocess.run([sys.executable, ROOT / "docker" / "check.py"], capture_output=True, text=True, check=False)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ok           build" in done.stdout and "ok           chroot" in done.stdout
