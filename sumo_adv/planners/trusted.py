"""Planners whose text is our own run in this process: the same answers, some 20 times as fast.

Our own is what we ship (``OWN``), and what differs from it in nothing but the table ``PARAMETERS`` (which is read and
never run here) and the word ``MOVEMENT``: so the expert writes new versions.  Whatever else a bank or a model brings
runs in the sandbox, and so does what fails here, for the sandbox's sentence.
"""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from operator import itemgetter
from typing import Any

from sumo_adv.datatypes import Planner
from sumo_adv.errors import SandboxError
from sumo_adv.planners.results import ENDPOINT_KEYS, check_endpoint
from sumo_adv.planners.session import Call, PlannerSession
from sumo_adv.planners.source import HELPERS_CODE, read_source

OWN = frozenset(
    {
        "77bf8ea4f8dfb60c99bc0ca2cbd8a80da105b2e23929600f59782caf2e5b6778",  # side
        "cd25301389c78c94ffe6c2c37db31d7daf0a99a103da8975332130dc9cba32bc",  # push
        "30c6b945830c0e9c283206cd1f4ba3b4b76a626755c78dea75ff976148ad4f61",  # brake
        "3139c7cbd6f6160ddee8dced3496e4a3fb71d8547fe0f617a4cbca036a5c612c",  # ambush
        "2cdfa2ddd2bd502df3fbf3152d9238f68b77b8312035b8fa7fd59dd22262b663",  # commit
        "e559c79121864387861ee3712bb5f2884ba85c469dba08ede83c1c9093a0a1d8",  # direct
        "209b4f7dcdab4d9802abb144839e1d962d86053ce9c7620d16f9166677743d15",  # hold
        "766e0c42bf2b383c8f20384758d9a4401a0a8cf7238b1d49cc241dbf29a4e7e1",  # tail
        "3f585326b826aa1423820b9942fb70dcc7d31807052d25234cddd783d1fe8ef3",  # weave
        "81f44b9a814836a281074662bd9a325e8868558b5d270afec19c2c13f4ae0b91",  # intrude
        "feb689cd98b768a336d9bd7943cc23ba8b7f6510a8d431142de0c6e60c8aa07a",  # straddle
        "d25d0f866d39ce2fc9e483f480f39a629f9968eb8d80a0f9aef8b569fb64de64",  # nudge
        "dbc945d6672740b2396dc8354633ab1b1672f1c19a478c836270063d66399e54",  # tail (a lane shift's)
    }
)
"""SHA-256 of the bodies of the planners in ``memory_bank/``, written down here: no bank can say what is ours."""

FIELDS = itemgetter(*ENDPOINT_KEYS)
MOVEMENT = re.compile(r'^MOVEMENT = "\w+"$', re.MULTILINE)


def body(source: str) -> str:
    """A planner's text from behind its table on. Raises PlannerSyntaxError."""
    read_source(source)  # the table is the first statement
    tree = ast.parse(source)
    table = next(node for node in tree.body if not isinstance(node, ast.Expr))
    lines = source.encode().splitlines(keepends=True)[(table.end_lineno or 1) - 1 :]
    lines[0] = lines[0][table.end_col_offset or 0 :]
    return b"".join(lines).decode()


def fingerprint(source: str) -> str:
    """What ``OWN`` has of a planner's text: SHA-256 of its body, whatever its movement. Raises PlannerSyntaxError."""
    return hashlib.sha256(MOVEMENT.sub('MOVEMENT = "any"', body(source)).encode()).hexdigest()


@lru_cache(maxsize=1024)
def _owned(source: str) -> bool:
    try:
        return fingerprint(source) in OWN
    except SandboxError:
        return False


def is_own(planner: Planner) -> bool:
    """Whether the text is one of ours, but for its numbers."""
    return _owned(planner.source)


class InProcessSession:
    """Answers as a ``PlannerSession`` does, for a planner that is our own; ``sandboxed`` opens one, where a call fails
    here. Of the text the body alone is run, which is the part that was compared.

    Raises:
        SandboxError: the planner is none of ours.
    """

    def __init__(
        self, planner: Planner, roads: Mapping[str, Mapping[str, Any]], sandboxed: Callable[[], PlannerSession]
    ) -> None:
        if not is_own(planner):
            raise SandboxError(f"The planner {planner.label}/{planner.mode} is none of ours: run it in the sandbox.")
        self._endpoint, self._roads, self._sandboxed = _loaded(planner.source), roads, sandboxed
        self._who = f"Planner {planner.label}/{planner.mode}"
        self._instead: PlannerSession | None = None

    def close(self) -> None:
        """Close what was opened. May be called twice."""
        if self._instead is not None:
            self._instead.close()

    def endpoint(self, *call: Any) -> dict[str, float]:
        """As ``PlannerSession.endpoint``."""
        (answer,) = self.endpoints([call])
        if isinstance(answer, SandboxError):
            raise answer
        return answer

    def endpoints(self, calls: Sequence[Call]) -> list[dict[str, float] | SandboxError]:
        """As ``PlannerSession.endpoints``."""
        if self._instead is None:
            try:
                return [self._answer(call) for call in calls]
            except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, SandboxError):
                self._instead = self._sandboxed()
        return self._instead.endpoints(calls)

    def _answer(self, call: Call) -> dict[str, float]:
        key, bv, ego, parameters, acc, horizon = call
        value = self._endpoint(bv, ego, self._roads[key], dict(parameters), acc, horizon)
        return check_endpoint(self._who, FIELDS(value))


@lru_cache(maxsize=256)
def _loaded(source: str) -> Callable[..., Any]:
    names: dict[str, Any] = {}
    exec(compile(HELPERS_CODE, "<helpers>", "exec"), names)
    exec(compile(body(source), "<planner>", "exec"), names)
    return names["endpoint"]
