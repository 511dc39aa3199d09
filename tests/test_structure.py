"""The shape of the source itself: imports point one way, modules state their purpose, nothing ties it to one
machine.
"""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "sumo_adv"
LEVELS = (
    (
        "asked",
        "consistency",
        "datatypes",
        "ego_sensing",
        "ego_way",
        "errors",
        "files",
        "geometry",
        "goal",
        "outcome_schema",
        "parsing",
        "road_users",
        "scenario_names",
        "script",
        "situation",
        "times",
    ),
    ("config", "config_odd", "metrics", "simulation", "memory"),
    ("planners", "drivers", "llm", "transformer"),
    ("search", "commonroad"),
    ("agents", "words"),
    ("episode",),
    ("serve", "campaigns", "benchmark", "womd", "report", "driver_check", "input_check"),
    ("regression", "rate", "hunting"),
    ("app", "comparison"),
    ("cli", "api", "api_batch", "gym", "__main__"),
)
"""From the bottom up: a part may import what stands below it, not its neighbours and not what is above."""
SIDEWAYS = {("asked", "datatypes"), ("asked", "road_users"), ("consistency", "datatypes"), ("consistency", "geometry"),
            ("config", "config_odd"), ("files", "errors"), ("outcome_schema", "errors"), ("parsing", "errors"),
            ("geometry", "datatypes"), ("goal", "datatypes"), ("road_users", "datatypes"),
            ("scenario_names", "datatypes"), ("situation", "datatypes"),
            ("situation", "geometry"), ("situation", "road_users"),
            ("benchmark", "campaigns"),
            ("report", "womd"), ("cli", "api"), ("cli", "api_batch"), ("api_batch", "api"),
            ("__main__", "cli")}  # fmt: skip
"""Pairs of neighbours of which the first may import the second."""
TOP = "sumo_adv"
SKIPPED = {".venv", ".git", "__pycache__", "runs", "build", "dist"}


def level_of(part: str) -> int:
    return next(i for i, level in enumerate(LEVELS) if part in level)


def part_of(module: str) -> str | None:
    """``sumo_adv.drivers.careful`` -> ``drivers``; None if it is not ours or the package itself."""
    names = module.split(".")
    return names[1] if names[0] == TOP and len(names) > 1 else None


def module_name(path: Path) -> str:
    names = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(names[:-1] if names[-1] == "__init__" else names)


def imported(tree: ast.AST) -> list[str]:
    """Every module imported at run time, anywhere in a file; what only type checkers see does not count."""
    modules: list[str] = []
    stack: list[ast.AST] = [tree]
    while stack:
        node = stack.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            stack.extend(node.orelse)
            continue
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            module = node.module or ""
            modules += [f"{module}.{alias.name}" for alias in node.names] if module == TOP else [module]
        stack.extend(ast.iter_child_nodes(node))
    return modules


def wrong_imports(source: str, module: str) -> list[str]:
    """Imports in ``source`` that point up, or sideways where that is not stated."""
    me = part_of(module)
    wrong = []
    for name in imported(ast.parse(source)):
        target = part_of(name)
        if me is None or target is None or target == me or target.startswith("__version"):
            continue
        if level_of(target) > level_of(me) or (level_of(target) == level_of(me) and (me, target) not in SIDEWAYS):
            wrong.append(name)
    return wrong


def source_files() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if not SKIPPED.intersection(path.parts))


def tracked_texts() -> dict[str, str]:
    """What git would keep, as text; outside a checkout whatever lies in the folder."""
    listing = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if listing.returncode == 0:
        paths = [ROOT / line for line in listing.stdout.splitlines()]
    else:
        paths = [path for path in ROOT.rglob("*") if not SKIPPED.intersection(path.relative_to(ROOT).parts)]
    texts = {}
    for path in paths:
        if path.is_file() and path.stat().st_size < 4_000_000:
            raw = path.read_bytes()
            if b"\0" not in raw:
                texts[str(path.relative_to(ROOT))] = raw.decode("utf-8")
    return texts


def test_every_part_has_its_level() -> None:
    parts = {path.name for path in PACKAGE.iterdir() if path.is_dir() and any(path.rglob("*.py"))}
    parts |= {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert parts <= {name for level in LEVELS for name in level}


@pytest.mark.parametrize("path", source_files(), ids=lambda path: module_name(path))
def test_imports_point_one_way(path: Path) -> None:
    assert wrong_imports(path.read_text(encoding="utf-8"), module_name(path)) == []


def test_the_rule_catches_what_it_should() -> None:
    assert wrong_imports("from sumo_adv.drivers import ego", "sumo_adv.metrics.ttc") == ["sumo_adv.drivers"]
    assert wrong_imports("def f():\n    import sumo_adv.cli.main", "sumo_adv.episode.loop") == ["sumo_adv.cli.main"]
    assert wrong_imports("from sumo_adv import drivers", "sumo_adv.datatypes") == ["sumo_adv.drivers"]
    assert wrong_imports("from sumo_adv.drivers import make_ego", "sumo_adv.episode.loop") == []
    hint = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from sumo_adv.drivers import ego"
    assert wrong_imports(hint, "sumo_adv.metrics.ttc") == []


@pytest.mark.parametrize("path", source_files(), ids=lambda path: module_name(path))
def test_every_module_says_what_it_is(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree) or not tree.body


def test_every_folder_is_a_package() -> None:
    folders = {path.parent for path in source_files()}
    assert [str(folder) for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_nothing_is_tied_to_one_machine() -> None:
    homes = re.compile(r"(?<![\w.:/-])/(?:" + "|".join(("work", "root", "home", "Users", "tmp")) + r")/\w")
    matches = {name: match.group() for name, text in tracked_texts().items() if (match := homes.search(text))}
    assert matches == {}


def test_nothing_is_downloaded_from_an_address_of_ours() -> None:
    archive = r"https?://\S+\.(?:whl|zip|tgz|tar\.\w+|gz|deb|rpm|exe|dmg|sh)\b"
    hosts = r"https?://\S*(?:pythonhosted|/releases/download/|/simple/)"
    option = r"--(?:extra-)?index-url|--find-links"
    address = re.compile(f"{archive}|{hosts}|{option}")
    own = str(Path(__file__).resolve().relative_to(ROOT))
    texts = {name: text for name, text in tracked_texts().items() if name != own}
    assert {name: match.group() for name, text in texts.items() if (match := address.search(text))} == {}


def test_constraints_are_plain_pins() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if not re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9_.!+]+", line)] == []
    assert "libsumo==1.28.0" in lines


def test_the_search_does_not_know_the_unseen_judges() -> None:
    """It uses ``cc_human`` and ``manoeuvre``; what judges beside them must not guide it."""
    for file in sorted((PACKAGE / "search").glob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        modules = {m for m in imported(tree) if m.startswith("sumo_adv.metrics.reference")}
        names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
        allowed = {"sumo_adv.metrics.reference.cc_human", "sumo_adv.metrics.reference.counterfactual"}
        assert modules <= allowed, file
        assert not names & {"BRAKERS", "REFERENCE_DRIVERS", "Reg157", "RssDriver", "Fsm", "answers"}, file
