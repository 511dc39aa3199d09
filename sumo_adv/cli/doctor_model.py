"""Ask the servers of the language models that the settings name, for ``doctor``."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import getproxies

from sumo_adv.cli.doctor_checks import DoctorFinding, FindingLevel, reason
from sumo_adv.config import Settings
from sumo_adv.errors import ModelError, SumoAdvError

if TYPE_CHECKING:
    from sumo_adv.llm.client import Server

CONNECT_TIMEOUT_S = 3.0  # longest time until a server accepts a connection
MAX_MODELS_LISTED = 5  # largest number of models named in a finding


def model(settings: Settings, environment: Mapping[str, str] = os.environ) -> Iterator[DoctorFinding]:
    """Check the server of each model that the settings name. No key is shown.

    A server is asked for its models, and one question with an answer of two tokens.

    Args:
        settings: The settings.
        environment: The environment variables.
    """
    from sumo_adv.agents.agents import AGENT_ROLES
    from sumo_adv.llm.client import REPLAY, find_server

    names = sorted({name for role in AGENT_ROLES if (name := settings.player(role)) is not None})
    level = FindingLevel.WARN if settings.fallback == "builtin" else FindingLevel.FAIL
    if not names:
        yield DoctorFinding(
            "model", FindingLevel.OK, "none is set: the built-in expert plays all parts (--llm NAME names one)"
        )
    for name in names:
        if name.startswith(REPLAY):
            there = Path(name.removeprefix(REPLAY)).is_file()
            state = "a recording, used instead of a model" if there else "a recording that does not exist"
            yield DoctorFinding(
                f"model {name}", FindingLevel.OK if there else level, state, "" if there else "give its path"
            )
            continue
        try:
            server = find_server(name, settings, environment)
        except SumoAdvError as error:
            yield DoctorFinding(f"model {name}", level, reason(error), "see docs/models.md")
            continue
        yield _out_of_reach(name, server, level) or _asked(name, server, settings, level)


def _out_of_reach(name: str, server: Server, level: FindingLevel) -> DoctorFinding | None:
    """Return a finding if a server, or the proxy on the way to it, accepts no connection; otherwise None."""
    parts = urlsplit(server.base_url)
    host, port = parts.hostname or "", parts.port or (443 if parts.scheme == "https" else 80)
    proxies = {} if host in ("localhost", "127.0.0.1", "::1") else getproxies()
    proxy = proxies.get(parts.scheme) or proxies.get("all")
    way = urlsplit(proxy) if proxy else None
    place = (way.hostname or "", way.port or 80) if way else (host, port)
    try:
        with socket.create_connection(place, timeout=CONNECT_TIMEOUT_S):
            return None
    except OSError as error:
        mend = "start the server, or correct SUMO_ADV_LLM_BASE_URL"
        through = "the proxy on the way to " if way else ""
        return DoctorFinding(
            f"model {name}", level, f"{through}{host}:{port} cannot be reached ({reason(error)})", mend
        )


def _asked(name: str, server: Server, settings: Settings, level: FindingLevel) -> DoctorFinding:
    """Ask a server and report what its answers show."""
    from sumo_adv.agents.analyzer import Analysis
    from sumo_adv.llm.server_check import check_server

    try:
        done = check_server(name, server, settings, Analysis.model_json_schema())
    except ModelError as error:
        found, _, mend = reason(error).rpartition("; ")
        return DoctorFinding(f"model {name}", level, found or mend, mend if found else "see docs/models.md")
    key = "with a key" if server.key is not None else "without a key"
    context = f", with a context of {done.context:,} tokens" if done.context is not None else ""
    models = f"; it lists {', '.join(done.listed[:MAX_MODELS_LISTED])}" if done.listed else ""
    more = " and others" if len(done.listed) > MAX_MODELS_LISTED else ""
    host = urlsplit(server.base_url).netloc
    return DoctorFinding(
        f"model {name}", FindingLevel.OK, f"{host} answers questions {key}; it takes a schema as {done.mode}{context}"
        f"{models}{more}",
    )  # fmt: skip
