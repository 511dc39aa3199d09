"""The sessions of many proposals: one session per planner, called for many vehicles and times at once.

Trusted planners run in this process. They give the same answers about 20 times as fast. The shipped texts, listed in
``TRUSTED``, are trusted. The table ``PARAMETERS``, the word ``MOVEMENT`` and the table ``SCRIPT`` may differ, because
versions of a planner and scripts differ in them. The table ``PARAMETERS`` is read and never run, and a table ``SCRIPT``
holds only words and numbers. Every other text of a bank or a model runs in the sandbox. If a trusted planner fails in
this process, it is run in the sandbox for the sandbox's error message.
"""

from __future__ import annotations

import ast
import hashlib
import math
import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from operator import itemgetter
from typing import Any, NoReturn

import numpy as np

from sumo_adv.datatypes import Planner, Proposal
from sumo_adv.errors import PlannerLimitError, SandboxError
from sumo_adv.planners.answers import Answer, AskOne, PlannerObservation, call_of, planner_road, world_endpoint
from sumo_adv.planners.follower import leaves_road
from sumo_adv.planners.results import ENDPOINT_KEYS, check_endpoint, notes_of, subject_of
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.session import MAX_STOPPED_CALLS, Call, PlannerSession
from sumo_adv.planners.text import HELPERS_CODE, read_planner_text
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

# -- trusted planners -----------------------------------------------------------------------------------------------

TRUSTED = frozenset(
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
        "dbc945d6672740b2396dc8354633ab1b1672f1c19a478c836270063d66399e54",  # tail of the lane shift
        "3421bf14c28f8f4a68dc8d44d9652e1116ad720bf4a3593ef8414dc2532dcff3",  # slow
        "c09f1cc28a10d892f50390c3c23209389d58c7fc3a86a3b5c052a90fbea2c3a4",  # swerve
        "1bbcad4a64fcffb80ea741e5395f26dc7a79bcd14c9367967aace3af5cf32c6e",  # cross
        "d75adb584fe0d8160ebfc7de895261a77dabfe13b821196b7b7e22cd1b8beb41",  # freeze
        "dd3f8c1b6715943daab7967516ba077268ed3b5fd3c79544b7a516993d6f0f4f",  # turn_back
        "16179d9fed3030023066e07ae717c4b97ea69434fbfcf4337898f73c23882f4c",  # onward
        "d917bdd6169126a7e3d25c0f9a9f326c229ba8e2feba6c49a19575269924b006",  # free, of free motions
        "cd088138c5c7ecfc11d5993c76a64d84d5a3d01fbb99ac783529e977341b1993",  # beside, of supports
        "5be1f147619f6221ea4bf3b634a4a60e47832fcc3ef4426ada7f2f7d4324e324",  # pace, of supports
        "4283ecf2a54fa972c12c8dbeb66c821855f5eeb135b5aa656e83d1dbd6da3485",  # pass, of supports
        "2081c29588729aee53054e6a5b5cb9958ef0646be665f7c3b30a24d6ca0b4999",  # script
        "efa3a8b6904d6534192c12dc3b4f175272cf8d9f0300e27ea73fcfadfd1f52a9",  # script of pedestrians and cyclists
    }
)
"""Fingerprints of the planners in ``memory_bank/``, ``search/support_intents.py``, ``search/intents.py`` and
``scripts.py``. This list is part of the code so that no bank can claim to be trusted."""

ENDPOINT_VALUES = itemgetter(*ENDPOINT_KEYS)
MOVEMENT = re.compile(r'^MOVEMENT = "\w+"$', re.MULTILINE)
_WORD_OR_NUMBER = r'(?:"[a-z0-9_]+"|-?[0-9]+\.[0-9]+)'
_ROW = rf"    \({_WORD_OR_NUMBER}(?:, {_WORD_OR_NUMBER}){{4}}\),\n"
SCRIPT = re.compile(rf"^SCRIPT = \[\n(?:{_ROW}){{1,8}}\]$", re.MULTILINE)


def body(text: str) -> str:
    """Return a planner's text after its table.

    Raises:
        PlannerSyntaxError: The text is not a planner.
    """
    read_planner_text(text)  # the table is the first statement
    tree = ast.parse(text)
    table = next(node for node in tree.body if not isinstance(node, ast.Expr))
    lines = text.encode().splitlines(keepends=True)[(table.end_lineno or 1) - 1 :]
    lines[0] = lines[0][table.end_col_offset or 0 :]
    return b"".join(lines).decode()


def fingerprint(text: str) -> str:
    """Return the SHA-256 of the body of a planner's text. It is equal for all movements and scripts.

    Raises:
        PlannerSyntaxError: The text is not a planner.
    """
    compared = SCRIPT.sub("SCRIPT = []", MOVEMENT.sub('MOVEMENT = "any"', body(text)))
    return hashlib.sha256(compared.encode()).hexdigest()


@lru_cache(maxsize=1024)
def _is_trusted_text(text: str) -> bool:
    try:
        return fingerprint(text) in TRUSTED
    except SandboxError:
        return False


def is_trusted(planner: Planner) -> bool:
    """Return whether the planner's text is a shipped one, apart from its parameters, movement and script."""
    return _is_trusted_text(planner.text)


class InProcessSession:
    """Runs a trusted planner in this process, with the interface of a ``PlannerSession``.

    It runs only the body of the text, which is the part that the fingerprint covers.
    """

    def __init__(
        self, planner: Planner, roads: Mapping[str, Mapping[str, Any]], open_sandboxed: Callable[[], PlannerSession]
    ) -> None:
        """Load the planner.

        Args:
            planner: The planner.
            roads: The ``road`` dictionaries by the keys that calls may name.
            open_sandboxed: Opens a session in the sandbox. After a call has failed in this process, that session
                answers all calls.

        Raises:
            SandboxError: The planner is not trusted.
        """
        self._subject = subject_of(planner)
        if not is_trusted(planner):
            raise SandboxError(f"{self._subject} is not trusted: run it in the sandbox.")
        self._endpoint, self._roads, self._open_sandboxed = _loaded(planner.text), roads, open_sandboxed
        self._sandboxed: PlannerSession | None = None

    def close(self) -> None:
        """Close the session in the sandbox, if there is one. A second call does nothing."""
        if self._sandboxed is not None:
            self._sandboxed.close()

    def endpoint(self, *call: Any) -> dict[str, float]:
        """Call the planner once; see ``PlannerSession.endpoint``."""
        (answer,) = self.endpoints([call])
        if isinstance(answer, SandboxError):
            raise answer
        return answer

    def endpoints(self, calls: Sequence[Call]) -> list[dict[str, float] | SandboxError]:
        """Call the planner for many states; see ``PlannerSession.endpoints``."""
        if self._sandboxed is None:
            try:
                return [self._answer(call) for call in calls]
            except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, SandboxError):
                self._sandboxed = self._open_sandboxed()
        return self._sandboxed.endpoints(calls)

    def _answer(self, call: Call) -> dict[str, float]:
        key, bv, ego, parameters, acc, horizon = call
        value = self._endpoint(bv, ego, self._roads[key], dict(parameters), acc, horizon)
        notes = (tuple(notes_of(value).items()),) if len(value) > len(ENDPOINT_KEYS) else ()
        return check_endpoint(self._subject, ENDPOINT_VALUES(value) + notes)


ROAD_KEY = "road"


def ask_trusted(proposal: Proposal, situation: Situation, fallback: AskOne) -> AskOne:
    """Return a function that calls the proposal's planner in this process, without the connections to its sandbox.

    Args:
        proposal: The candidate.
        situation: The situation of the candidate's encounter.
        fallback: Answers calls that fail in this process.

    Returns:
        The function. It is ``fallback`` itself if the planner is not trusted or the motion is prescribed.
    """
    if proposal.course is not None or not is_trusted(proposal.planner):
        return fallback
    session = InProcessSession(proposal.planner, {ROAD_KEY: planner_road(situation, proposal.bv)}, _no_session)

    def ask(observation: PlannerObservation) -> Answer | str:
        try:
            end = session.endpoint(*call_of(proposal, ROAD_KEY, observation, situation.horizon))
            return Answer(world_endpoint(situation, end), notes=notes_of(end))
        except SandboxError:
            return fallback(observation)

    return ask


def _no_session() -> NoReturn:
    raise SandboxError("The call failed here, and its sandbox is in another process.")


@lru_cache(maxsize=256)
def _loaded(text: str) -> Callable[..., Any]:
    names: dict[str, Any] = {}
    exec(compile(HELPERS_CODE, "<helpers>", "exec"), names)
    exec(compile(body(text), "<planner>", "exec"), names)
    return names["endpoint"]


# -- sessions of proposals ------------------------------------------------------------------------------------------

TRAJECTORY_BATCH_S = 20.0  # time for one planner's trajectory() in a batch of predictions


class Roads:
    """The ``road`` dictionaries of an encounter's BVs. Each is made when it is first needed.

    Attributes:
        situations: The encounter's situations by delay after the trigger [s].
    """

    def __init__(self, situations: Mapping[float, Situation]) -> None:
        """Begin without roads."""
        self.situations = situations
        self._made: dict[str, dict[str, Any]] = {}

    def of(self, proposals: Iterable[Proposal]) -> dict[str, dict[str, Any]]:
        """Return the roads of the proposals' BVs by ``road_key``. BVs that are not in the encounter are left out."""
        by_key = {road_key(p): p for p in proposals if p.bv in self.situations[p.delay].targets}
        for key in by_key.keys() - self._made.keys():
            self._made[key] = planner_road(self.situations[by_key[key].delay], by_key[key].bv)
        return {key: self._made[key] for key in by_key}


def road_key(proposal: Proposal) -> str:
    """Return the key of a proposal's road in a session, which consists of its BV and its delay."""
    return f"{proposal.bv} {proposal.delay}"


class Sessions:
    """One session for each planner of the proposals. Proposals with a prescribed motion need none.

    It is a context manager that opens and closes the sessions.

    Attributes:
        failures: A sentence for each planner that is no longer called, by the planner's hash. These planners failed for
            all of their proposals or reached a limit ``MAX_STOPPED_CALLS`` times.
        stopped: The number of calls that reached a limit, including earlier ones, by the planner's hash.
        broken: A sentence for each proposal that failed, by its index. ``answers`` does not call these again.
    """

    def __init__(
        self, sandbox: Sandbox, roads: Roads, proposals: Sequence[Proposal], seed: int,
        failed: Mapping[str, str] | None = None, *, drivable: Drivable | None = None, in_process: bool = False,
        stopped: Mapping[str, int] | None = None,
    ) -> None:  # fmt: skip
        """Group the proposals by planner.

        Args:
            sandbox: Runs planners that are not trusted.
            roads: The roads of the encounter.
            proposals: The candidates.
            seed: The seed of the planners' ``random``.
            failed: A sentence for each planner that failed earlier, by hash. These planners are not called again.
            drivable: The road surface that the planners' own trajectories must stay on; None means no check.
            in_process: Whether trusted planners run in this process.
            stopped: The number of each planner's calls that reached a limit earlier, by hash.
        """
        self._roads, self._drivable, self._in_process = roads, drivable, in_process
        self._spent: dict[str, float] = defaultdict(float)  # planner hash -> s in its trajectory()
        self._sandbox, self._seed = sandbox, seed
        self._open: dict[str, PlannerSession | InProcessSession] = {}
        self.failures: dict[str, str] = dict(failed or {})
        self.stopped = Counter(stopped or {})
        self.broken: dict[int, str] = {}
        self._proposals: dict[str, list[Proposal]] = {}  # by planner hash
        for p in proposals:
            if self.stopped[p.planner.hash] >= MAX_STOPPED_CALLS:
                reason = "it ran into its limits again and again, and is not asked any more: make it faster."
                self.failures.setdefault(p.planner.hash, f"{subject_of(p.planner)}: {reason}")
            if p.course is None and p.planner.hash not in self.failures:
                self._proposals.setdefault(p.planner.hash, []).append(p)

    def __enter__(self) -> Sessions:
        for name, proposals in self._proposals.items():
            planner, roads = proposals[0].planner, self._roads.of(proposals)
            open_sandboxed = partial(self._sandbox.session, planner, roads, seed=self._seed)
            if self._in_process and is_trusted(planner):
                self._open[name] = InProcessSession(planner, roads, open_sandboxed)
                continue
            try:
                self._open[name] = open_sandboxed()
            except SandboxError as error:
                self.failures[name] = str(error)
        return self

    def __exit__(self, *_: object) -> None:
        for session in self._open.values():
            session.close()

    def answer(self, proposal: Proposal, observation: PlannerObservation) -> Answer | str:
        """Call a proposal's planner once, and return its answer or a sentence that says why there is none."""
        name = proposal.planner.hash
        if name in self.failures:
            return self.failures[name]
        try:
            end: dict[str, float] = self._open[name].endpoint(*self._call(proposal, observation))
            return self._answer(proposal, observation, end, math.inf)
        except SandboxError as error:
            return str(error)

    def answers(
        self, proposals: Sequence[Proposal], rows: Sequence[int], observations: Sequence[PlannerObservation]
    ) -> list[Answer | None]:
        """Call the planners of many proposals.

        Args:
            proposals: The candidates.
            rows: The indices of the candidates whose planners are called.
            observations: The observation of each candidate.

        Returns:
            The answer for each candidate. It is None if the candidate is not in ``rows`` or its planner failed.
        """
        answers: list[Answer | None] = [None] * len(observations)
        rows_of: dict[str, list[int]] = {}
        for k in rows:
            name = proposals[k].planner.hash
            if name in self._open and name not in self.failures and k not in self.broken:
                rows_of.setdefault(name, []).append(k)
        for name, asked_rows in rows_of.items():
            calls = [self._call(proposals[k], observations[k]) for k in asked_rows]
            try:
                ends = self._open[name].endpoints(calls)
            except SandboxError as error:
                self.failures[name] = str(error)
                continue
            for k, end in zip(asked_rows, ends, strict=True):
                try:
                    if isinstance(end, SandboxError):
                        raise end
                    answers[k] = self._answer(proposals[k], observations[k], end, TRAJECTORY_BATCH_S)
                except SandboxError as error:
                    self.broken[k] = str(error)
                    self.stopped[name] += isinstance(error, PlannerLimitError)
            broken = [self.broken[k] for k in sorted(self.broken) if proposals[k].planner.hash == name]
            if len(broken) >= len(self._proposals[name]) or self.stopped[name] >= MAX_STOPPED_CALLS:
                self.failures[name] = broken[0]
        return answers

    def _call(self, proposal: Proposal, observation: PlannerObservation) -> Call:
        return call_of(proposal, road_key(proposal), observation, self._situation(proposal).horizon)

    def _situation(self, proposal: Proposal) -> Situation:
        return self._roads.situations[proposal.delay]

    def _answer(
        self, proposal: Proposal, observation: PlannerObservation, end: dict[str, float], seconds: float
    ) -> Answer:
        """Make the answer: an endpoint in the world, and the planner's own trajectory if it stays on the road.

        Raises:
            PlannerLimitError: Earlier calls of the planner's ``trajectory`` took more than ``seconds``.
            SandboxError: The planner's ``trajectory`` failed.
        """
        situation, planner = self._situation(proposal), proposal.planner
        endpoint, notes, session = world_endpoint(situation, end), notes_of(end), self._open[planner.hash]
        if isinstance(session, InProcessSession) or not session.has_trajectory:
            return Answer(endpoint, notes=notes)
        if self._spent[planner.hash] > seconds:
            raise PlannerLimitError(f"{subject_of(planner)}: trajectory() is too slow for predictions: make it faster.")
        began = time.perf_counter()
        local = session.trajectory(road_key(proposal), observation[0], end, situation.dt)
        self._spent[planner.hash] += time.perf_counter() - began
        states = np.array([(*situation.frame.to_world(x, y, h), v) for x, y, h, v in local])
        bv = situation.targets[proposal.bv].state
        if self._drivable is not None:
            leaves = leaves_road(states, bv.length, bv.width, situation.dt, self._drivable)
            if leaves is not None:
                remark = f"trajectory() leaves the road {leaves:.1f} s later, and the built-in one was driven"
                return Answer(endpoint, None, remark, notes)
        return Answer(endpoint, states, notes=notes)
