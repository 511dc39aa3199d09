"""The folder that ``serve`` writes: ``serve.json``, and a folder for each encounter."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sumo_adv.config import Settings
from sumo_adv.errors import UsageError
from sumo_adv.serve import Options

SERVE_FILE = "serve.json"


def claim(target: Path, *, force: bool) -> None:
    """Make the output folder. Raises UsageError if it is taken or cannot be made."""
    try:
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            if not force:
                raise UsageError(f"The output folder {target} is there already; give another --out, or --force.")
            if not (target / SERVE_FILE).is_file():
                raise UsageError(f"{target} is not the folder of a server, so --force does not replace it.")
            shutil.rmtree(target)
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"The output folder {target} cannot be written ({error.strerror or error}).") from error


def note(target: Path, given: Any, settings: Settings, options: Options, summary: Mapping[str, Any] | None) -> None:
    """``serve.json``: the job of this server, and at the end its outcome."""
    from dataclasses import asdict

    from sumo_adv.report.outcome import SCHEMA, versions

    secret = {"memory", "llm_api_key", "llm_base_url"} & set(type(settings).model_fields)
    value = {
        "schema": SCHEMA, "input": given.name, "versions": versions(), "options": asdict(options),
        "settings": settings.model_dump(mode="json", exclude=secret), "summary": summary,
    }  # fmt: skip
    part = target / f".{SERVE_FILE}.part"
    part.write_text(json.dumps(value, indent=2, ensure_ascii=False, default=str) + "\n", encoding="utf-8")
    part.replace(target / SERVE_FILE)


def folder_writer(target: Path) -> Any:
    """Writes one encounter's folder whole; inputs that several have are on the disk once."""
    from sumo_adv.report.folder import write_run
    from sumo_adv.report.staging import staged

    def write(episode: Any, number: int) -> dict[str, Any]:
        with staged(target / f"encounter-{number:04d}", force=False) as folder:
            result = write_run(folder, episode)
            _share(folder.stage / "inputs", target / "inputs")
            folder.keep(force=False)
        return {**result, "folder": folder.target}

    return write


def _share(inputs: Path, shared: Path) -> None:
    """Hard links between copies of the same content (the names say it), where the file system has such."""
    shared.mkdir(exist_ok=True)
    for file in inputs.iterdir():
        original, part = shared / file.name, inputs / f".{file.name}.part"
        try:
            if original.exists():
                os.link(original, part)
                part.replace(file)
            else:
                os.link(file, original)
        except OSError:
            return
