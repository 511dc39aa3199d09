"""``doctor --llm`` against servers on loopback: a good one, and all that makes a server unusable."""

from __future__ import annotations

import json
import socket
from typing import Any

import pytest
from cli_samples import Program
from model_server import KEY, Answer, Asked, Drop, ModelServer, Raw, Say, status

from sumo_adv.cli.doctor_checks import DoctorFinding, FindingLevel
from sumo_adv.cli.doctor_model import model
from sumo_adv.config import Settings, load_settings
from sumo_adv.llm.server_check import PROBE_ANSWER_TOKENS, PROBE_QUESTION_TOKENS

BEGUN = Say(
    '{"', finish="length", usage={"prompt_tokens": PROBE_QUESTION_TOKENS, "completion_tokens": PROBE_ANSWER_TOKENS}
)


def settings(**given: object) -> Settings:
    return load_settings(None, **given)


def models(**entry: Any) -> Raw:
    """A list of one model."""
    return Raw(200, json.dumps({"object": "list", "data": [{"id": "mine", "object": "model", **entry}]}).encode())


def found(server: ModelServer, **given: object) -> DoctorFinding:
    (finding,) = model(settings(llm="mine", llm_base_url=server.base_url, llm_api_key=KEY, **given), {})
    assert KEY not in finding.found + finding.mend
    return finding


def test_a_good_server_is_asked_for_its_models_and_one_question_of_two_tokens() -> None:
    with ModelServer([BEGUN], models(max_model_len=32_768)) as server:
        finding = found(server)
    assert finding.level is FindingLevel.OK
    assert (
        "with a key; it takes a schema as json_schema, with a context of 32,768 tokens; it lists mine" in finding.found
    )
    (question,) = server.asked
    assert question.mode == "json_schema" and question.body["max_tokens"] == 2 and len(question.last) < 10


def test_a_server_without_a_list_gets_a_question_as_long_as_real_ones() -> None:
    with ModelServer([BEGUN]) as server:
        finding = found(server)
    assert finding.level is FindingLevel.OK and "lists" not in finding.found
    assert len(server.asked[0].last.split()) == PROBE_QUESTION_TOKENS


def long_refused(request: Asked) -> Answer:
    """vLLM and llama.cpp refuse a question that is longer than their context of 4,096."""
    return (
        status(400, "the request exceeds the available context size (4096 tokens)")
        if len(request.last) > 16_384
        else BEGUN
    )


CUT = Say('{"', usage={"prompt_tokens": 4_094, "completion_tokens": 2})
UNUSABLE: dict[str, tuple[Any, Raw | None, str]] = {
    "a wrong key for the list": ([BEGUN], status(401, "no"), "does not accept the key for its list of models"),
    "a wrong key for questions": ([status(401, "no")], models(), "does not accept the key (status 401: no)"),
    "a context of 4,096 in the list": ([BEGUN], models(max_model_len=4_096), "has a context of 4,096 tokens"),
    "llama.cpp's": ([BEGUN], models(meta={"n_ctx": 4_096}), "has a context of 4,096 tokens"),
    "a context of 4,096, not told": (long_refused, models(), "longer than the model's context"),
    "a context of 4,096, cut without a word": ([CUT], None, "cut a question of 8,000 tokens to 4,094"),
    "no such model": ([status(404, "no such model")], models(), "does not know this model"),
    "no server of models": ([Raw(200, b"<html>")] * 4, Raw(200, b"<html>"), "answer that cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("case", UNUSABLE)
def test_a_server_that_cannot_be_used_is_found(case: str) -> None:
    script, listing, says = UNUSABLE[case]
    with ModelServer(script, listing) as server:
        finding = found(server, llm_retries=0)
    assert finding.level is FindingLevel.FAIL and says in finding.found, finding
    assert finding.mend


def test_a_place_that_takes_connections_alone_is_no_server() -> None:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        address = f"http://127.0.0.1:{listening.getsockname()[1]}/v1"
        finding = next(model(settings(llm="mine", llm_base_url=address, llm_read_timeout=0.2), {}))
    assert finding.level is FindingLevel.FAIL and "did not answer GET models" in finding.found


def test_a_weaker_server_is_used_in_the_way_it_knows() -> None:
    """It knows no ``json_schema``, which is no fault: doctor says how the schema is sent."""

    def script(request: Asked) -> Answer:
        return status(500, "response_format: unknown") if request.mode == "json_schema" else BEGUN

    with ModelServer(script) as server:
        assert "takes a schema as json_object" in found(server).found


def test_a_model_without_a_key_or_a_recording() -> None:
    (hosted,) = model(settings(llm="deepseek-chat"), {})
    assert hosted.level is FindingLevel.FAIL and "DEEPSEEK_API_KEY" in hosted.found
    (lost,) = model(settings(analyzer="replay:nowhere.jsonl", fallback="builtin"), {})
    assert lost.level is FindingLevel.WARN
    (none,) = model(settings(), {})
    assert "built-in expert" in none.found


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ({"ALL_PROXY": "socks5://{proxy}"}, "SOCKS"),
        ({"HTTPS_PROXY": "socks7://{proxy}"}, "Unknown scheme"),
        ({"HTTPS_PROXY": "http://{proxy}", "SSL_CERT_FILE": "gone.pem"}, "No such file"),
    ],
)
def test_a_proxy_or_certificate_of_the_machine_that_cannot_be_used(
    program: Program, setting: dict[str, str], says: str
) -> None:
    """Nothing is sent. With ``fallback``, the built-in expert plays."""
    with socket.socket() as proxy:
        proxy.bind(("127.0.0.1", 0))
        proxy.listen()
        place = f"127.0.0.1:{proxy.getsockname()[1]}"
        program.variables = {
            **dict.fromkeys(("ALL_PROXY", "HTTPS_PROXY", "HTTP_PROXY", "NO_PROXY", "SSL_CERT_FILE"), ""),
            **{name: value.format(proxy=place) for name, value in setting.items()},
            "SUMO_ADV_LLM_BASE_URL": "https://models.invalid/v1", "SUMO_ADV_LLM_API_KEY": KEY,
        }  # fmt: skip
        done = program.here("doctor", "--llm", "mine")
        assert done.status == 1 and "cannot be used (" in done.out and says in done.out, done.out
        assert "correct or unset ALL_PROXY" in done.out
        if says == "SOCKS":
            done = program.here(
                "run", "leader_two_lanes", "--llm", "mine", "--fallback", "builtin", "--attempts", "1",
                "--learn", "off", "--out", "out",
            )  # fmt: skip
            assert done.status == 0 and len(done.outcome["attempts"]) == 1, done.err
            assert "The proxy or certificate setting of this machine" in json.dumps(done.outcome["agents"])


def test_the_command_fails_with_a_server_that_drops_every_question(program: Program) -> None:
    with ModelServer(lambda request: Drop(), models(max_model_len=32_768)) as server:
        program.variables = {**server.environment(), "SUMO_ADV_LLM_QUESTION_SECONDS": "2"}
        done = program.here("doctor", "--llm", "mine")
    assert done.status == 1 and "fail  model mine: " in done.out and KEY not in done.out
