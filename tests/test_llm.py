"""The client of language models against a real server on loopback, faults included."""

from __future__ import annotations

import asyncio
import gzip
import json
import re
import signal
import socket
import threading
import time
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from model_server import KEY, Answer, Asked, Cut, Drip, Hang, Large, ModelServer, Raw, Say, StepClock, no_schema, status

from sumo_adv.config import ModelSettings, load_settings
from sumo_adv.errors import BudgetError, ModelError, UsageError
from sumo_adv.llm.chat import Budget, ChatReply, ChatRequest, Ledger
from sumo_adv.llm.client import find_server, open_model

SCHEMA = {"type": "object", "properties": {"a": {"type": "integer", "default": 1}}}
BOMB = gzip.compress(gzip.compress(bytes(20_000_000)))  # 20 MB in some hundred bytes
QUESTION = ChatRequest("analyzer", (("system", "Be brief."), ("user", "What?")))
WITH_SCHEMA = ChatRequest("analyzer", QUESTION.messages, SCHEMA, "Thing")


def answer(server: ModelServer, request: ChatRequest = QUESTION, **given: Any) -> tuple[ChatReply, Ledger, StepClock]:
    ledger, clock = Ledger(), StepClock()
    model = open_model("test-model", server.settings(**given), ledger, clock=clock)
    return model.complete(request), ledger, clock


def failure(script: Any, **given: Any) -> tuple[str, Ledger, StepClock, ModelServer]:
    """The message of a question that fails; the key is not in it."""
    ledger, clock = Ledger(), StepClock()
    with ModelServer(script) as server:
        model = open_model("test-model", server.settings(**given), ledger, clock=clock)
        with pytest.raises(ModelError) as caught:
            model.complete(QUESTION)
    assert KEY not in str(caught.value) and KEY not in repr(caught.value)
    assert f"127.0.0.1:{server.base_url.split(':')[2].split('/')[0]}" in str(caught.value)
    return str(caught.value), ledger, clock, server


def test_a_question_and_its_answer() -> None:
    with ModelServer([Say("Braking.", reasoning="It is close.")]) as server:
        reply, ledger, _ = answer(server, llm_temperature=0.5)
    assert (reply.text, reply.reasoning, reply.retries, reply.mode) == ("Braking.", "It is close.", 0, "text")
    (question,) = server.asked
    assert question.headers["Authorization"] == f"Bearer {KEY}"
    assert question.headers["Accept-Encoding"] == "identity"
    assert question.body == {
        "model": "test-model", "stream": False, "temperature": 0.5,
        "messages": [{"role": "system", "content": "Be brief."}, {"role": "user", "content": "What?"}],
    }  # fmt: skip
    counts = {
        "calls": 1, "prompt_tokens": 100, "completion_tokens": 10, "cached_tokens": 40, "seconds": 0.0, "retries": 0,
        "re_asks": 0, "dropped": 0,
    }  # fmt: skip
    assert ledger.as_dict() == {**counts, "agents": {"analyzer": counts}}


def test_reasoning_has_two_names_and_tokens_are_estimated_where_none_are_counted() -> None:
    with ModelServer([Say("12345678", reasoning="why", reasoning_key="reasoning", usage=None)]) as server:
        reply, _, _ = answer(server)
    assert reply.reasoning == "why"
    assert (reply.prompt_tokens, reply.completion_tokens) == (4, 3)  # 14 and 11 characters


def test_a_schema_is_sent_in_strict_mode() -> None:
    with ModelServer([Say({"a": 2})]) as server:
        reply, _, _ = answer(server, WITH_SCHEMA)
    assert (reply.text, reply.mode) == ('{"a": 2}', "json_schema")
    strict = {
        "type": "object",
        "properties": {"a": {"type": "integer"}},
        "required": ["a"],
        "additionalProperties": False,
    }
    assert server.asked[0].body["response_format"]["json_schema"] == {"name": "Thing", "strict": True, "schema": strict}
    assert server.asked[0].system.startswith("Be brief.\n") and server.asked[0].system.endswith(json.dumps(SCHEMA))
    assert "default" in SCHEMA["properties"]["a"]  # type: ignore[index]


@pytest.mark.parametrize(
    ("refused", "mode", "calls"), [(("json_schema",), "json_object", 2), (("json_schema", "json_object"), "text", 3)]
)
def test_the_supported_schema_mode_is_remembered(refused: tuple[str, ...], mode: str, calls: int) -> None:
    with ModelServer(no_schema(Say({"a": 2}), refused)) as server:
        model = open_model("test-model", server.settings(), Ledger(), clock=StepClock())
        first, second = model.complete(WITH_SCHEMA), model.complete(WITH_SCHEMA)
    assert (first.mode, first.retries, second.mode, second.retries) == (mode, calls - 1, mode, 0)
    assert len(server.asked) == calls + 1
    assert '"properties"' in server.asked[-1].system


def test_a_400_for_other_reasons_says_so_and_changes_nothing() -> None:
    with ModelServer([*[status(400, "the prompt is too long")] * 3, Say({"a": 1})]) as server:
        model = open_model("test-model", server.settings(), Ledger(), clock=StepClock())
        with pytest.raises(ModelError, match="too long"):
            model.complete(WITH_SCHEMA)
        assert model.complete(WITH_SCHEMA).mode == "json_schema"


@pytest.mark.parametrize(
    "fault", [status(500), status(503, "busy"), status(429), Cut(), Raw(200, b'{"choices": [{'), Raw(200, b"")]
)
def test_temporary_faults_are_retried(fault: Answer) -> None:
    with ModelServer([fault, fault, Say("At last.")]) as server:
        reply, ledger, clock = answer(server)
    assert (reply.text, reply.retries, len(server.asked)) == ("At last.", 2, 3)
    assert 0.25 <= clock.slept[0] <= 0.5 <= clock.slept[1] <= 1.0
    assert ledger.as_dict()["retries"] == 2 and reply.seconds == round(sum(clock.slept), 3)


def test_the_last_retry_fails_with_its_reason() -> None:
    message, ledger, clock, server = failure(lambda request: status(503, f"busy, {KEY}"))
    assert "(status 503: busy, ***), also after 3 retries" in message
    assert len(server.asked) == 4 and ledger.as_dict()["calls"] == 1 and ledger.as_dict()["retries"] == 3
    assert ledger.as_dict()["seconds"] == pytest.approx(sum(clock.slept), abs=0.001)


def test_retry_after_is_respected() -> None:
    later = format_datetime(datetime.now(UTC) + timedelta(seconds=90), usegmt=True)
    faults = [status(429, Retry_After="7"), status(503, Retry_After=later), status(429, Retry_After="soon")]
    with ModelServer([*faults, Say("Yes.")]) as server:
        _, _, clock = answer(server)
    assert clock.slept[0] == 7.0 and 80.0 < clock.slept[1] <= 90.0 and clock.slept[2] <= 2.0


def test_a_wait_beyond_the_deadline_fails_at_once() -> None:
    message, _, clock, server = failure([status(429, "slow down", Retry_After="60")], llm_question_seconds=30)
    assert (
        "slow down" in message
        and "the next try would be 60 s later, but a question may take only 30 s; raise" in message
    )
    assert clock.slept == [] and len(server.asked) == 1


@pytest.mark.parametrize("fault", [Drip(), Drip(in_headers=True), Hang()])
def test_one_deadline_holds_for_the_whole_question(fault: Answer) -> None:
    message, _, _, server = failure([fault], llm_question_seconds=0.3)
    assert "did not answer within 0.3 s" in message and len(server.asked) == 1


def test_a_read_timeout_is_retried() -> None:
    with ModelServer([Hang(), Say("Here.")]) as server:
        reply, _, _ = answer(server, llm_read_timeout=0.2)
    assert (reply.text, reply.retries) == ("Here.", 1)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (Large(), "more than 2 MB"),
        (Raw(200, BOMB, {"Content-Encoding": "gzip, gzip"}), "Content-Encoding gzip, gzip, which is refused"),
        (Raw(200, b'{"hello": 1}'), "no choices"),
        (Raw(200, b'{"choices": []}'), "no choices"),
        (Raw(200, b'{"choices": [{"message": {"content": 5}}]}'), "no choices"),
        (Raw(200, b'{"error": {"message": "model overloaded"}}'), "model overloaded"),
        (Raw(200, b'{"choices": [{"message": {"content": null, "refusal": "I will not"}}]}'), "I will not"),
        (status(401, f"bad key {KEY}"), r"the key \(status 401: bad key \*\*\*\); set SUMO_ADV_LLM_API_KEY"),
        (status(403), "choose another model"),
        (status(404, "no such model"), "check the name 'test-model'"),
        (status(400, "no\n\x1b[31mgood"), "rejected the question .status 400: no .31mgood"),
        (Raw(301, b"", {"Location": "http://elsewhere.invalid/"}), r"redirects to another address \(status 301\); set"),
        (Raw(418, b"<html>teapot</html>"), "teapot"),
    ],
)  # fmt: skip
def test_permanent_faults_are_not_retried(fault: Answer, says: str) -> None:
    message, ledger, _, server = failure([fault])
    assert re.search(says, message), message
    assert len(server.asked) == 1 and "\n" not in message and "\x1b" not in message
    assert ledger.as_dict()["calls"] == 1


ESCAPED = "".join(f"\\u{ord(c):04x}" for c in KEY)  # as JSON may spell it
SPELLINGS = {
    "as it is": KEY, "its first character escaped": "\\u0073" + KEY[1:], "all of it escaped": ESCAPED,
    "in capitals": ESCAPED.upper().replace("\\U", "\\u"), "escaped for JSON in JSON": ESCAPED.replace("\\", "\\\\"),
    "as a planner would write it": "\\\\x73" + KEY[1:], "as in an address": "%73" + KEY[1:],
}  # fmt: skip


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_key_in_an_answer_is_blanked_however_it_is_spelt(spelling: str, coding: str) -> None:
    """Also where its halves are parts that the client puts together."""
    parts = [f'{{"text": "{text}"}}' for text in ("Key: sk-tests", "-0123456789.")]
    body = (
        f'{{"choices": [{{"message": {{"content": "{SPELLINGS[spelling]}", "reasoning": "{SPELLINGS[spelling]}"}}}}]}}'
    )
    halves = f'{{"choices": [{{"message": {{"content": [{", ".join(parts)}]}}}}]}}'
    with ModelServer([Raw(200, body.encode(coding)), Raw(200, halves.encode(coding))]) as server:
        reply, _, _ = answer(server)
        assert (reply.text, reply.reasoning) == ("***", "***")
        assert answer(server)[0].text == "Key: ***."


@pytest.mark.parametrize("coding", ["utf-8", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_key_in_an_error_is_blanked_too(spelling: str, coding: str) -> None:
    """At the place where a message cuts a long text, too: 200 characters."""
    shown = "x" * 185 + SPELLINGS[spelling]
    for body in (shown, f'{{"error": {{"message": "{shown}"}}}}', f'{{"error": {{"code": "{shown}"}}}}'):
        message, *_ = failure([Raw(401, body.encode(coding))])
        detail = message.partition("status 401")[2]
        assert KEY[:4] not in detail and "73" not in detail and "***" in detail


def test_a_key_in_a_header_is_blanked() -> None:
    message, *_ = failure([Raw(200, b"", {"Content-Encoding": KEY})])
    assert "Content-Encoding ***" in message


def test_looking_for_the_key_takes_no_longer_than_reading() -> None:
    """Two million backslashes, and as many beginnings of a key, within the time of a question."""
    for text in ("\\" * 1_900_000, "sk-tests-" * 200_000, "s\x00" * 900_000):
        message, *_ = failure([Raw(401, text.encode())], llm_question_seconds=30.0)
        assert "does not accept the key" in message


def test_a_missing_server_is_reported_at_once() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    clock = StepClock()
    model = open_model(
        "ollama:llama3", ModelSettings(llm_base_url=f"http://localhost:{port}/v1"), Ledger(), clock=clock
    )
    with pytest.raises(ModelError, match=f"localhost:{port} of model ollama:llama3 cannot be reached .*start it, or"):
        model.complete(QUESTION)
    assert clock.slept == []


@pytest.mark.parametrize(
    ("code", "body"),
    [
        (404, "404 page not found"),  # Ollama
        (404, '{"error": {"message": "Invalid URL (POST /chat/completions)", "type": "invalid_request_error"}}'),
        (405, "Method Not Allowed"),
        (200, '{"error": "Unexpected endpoint or method. (POST /chat/completions)"}'),  # LM Studio
        (200, "<html>the page of the server</html>"),
    ],
)
def test_an_address_without_v1_is_named(code: int, body: str) -> None:
    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(code)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body.encode())

        def log_message(self, *_: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        for url, said in ((address, True), (f"{address}/v1", False)):
            model = open_model("my-own", ModelSettings(llm_base_url=url), Ledger(), clock=StepClock())
            with pytest.raises(ModelError) as caught:
                model.complete(QUESTION)
            assert (f"; set SUMO_ADV_LLM_BASE_URL to {address}/v1, where" in str(caught.value)) == said
        server.shutdown()


def test_no_more_questions_at_once_than_allowed() -> None:
    gate = threading.Barrier(2, timeout=20)

    def script(request: Asked) -> Answer:
        gate.wait()
        return "Yes."

    with ModelServer(script) as server:
        model = open_model("test-model", server.settings(llm_concurrency=2), Ledger(), clock=StepClock())
        threads = [threading.Thread(target=model.complete, args=(QUESTION,)) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(server.asked) == 6 and server.most_at_once == 2


@pytest.mark.parametrize(
    ("budget", "answered", "says"),
    [
        (Budget(calls=2), 2, "used its 2 calls of language models; raise llm_max_calls"),
        (Budget(tokens=200), 1, "200 tokens of the run, of which 110 are used; raise llm_max_tokens"),
        (Budget(seconds=0), 0, "used its 0 s of language models; raise llm_max_seconds"),
    ],
)
def test_budgets_end_before_the_call_that_would_exceed_them(budget: Budget, answered: int, says: str) -> None:
    long = ChatRequest("analyzer", (("user", "x" * 396),))  # 99 tokens
    ledger = Ledger(budget)
    with ModelServer(lambda request: "Yes.") as server:
        model = open_model("test-model", server.settings(), ledger, clock=StepClock())
        for _ in range(answered):
            model.complete(long)
        with pytest.raises(BudgetError, match=says):
            model.complete(long)
    assert len(server.asked) == ledger.as_dict()["calls"] == answered


def test_parallel_questions_are_waited_for_once() -> None:
    """One is open from 10 s to 13 s, another one from 11 s to 14 s: 4 s; a third from 20 s to 21 s makes it 5 s."""
    times = iter([10.0, 14.0, 20.0, 21.0])  # the clock is asked when the first is opened and when the last is closed
    ledger = Ledger(clock=lambda: next(times))
    first, second = ledger.waiting(), ledger.waiting()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert ledger.waited == 0
    second.__exit__(None, None, None)
    assert ledger.waited == 4
    with pytest.raises(KeyError), ledger.waiting():
        raise KeyError  # a question that fails was waited for as well
    assert ledger.waited == 5


def test_the_runs_time_cuts_a_question_short() -> None:
    with ModelServer([Hang()]) as server:
        model = open_model("test-model", server.settings(), Ledger(Budget(seconds=0.3)), clock=StepClock())
        with pytest.raises(BudgetError, match="ended during a question"):
            model.complete(QUESTION)


def test_it_works_inside_a_running_event_loop() -> None:
    async def ask() -> str:
        return answer(server)[0].text

    with ModelServer(["Yes."]) as server:
        assert asyncio.run(ask()) == "Yes."


@pytest.mark.parametrize(
    ("name", "settings", "environment", "url", "authorized"),
    [
        ("deepseek-chat", {}, {"DEEPSEEK_API_KEY": "k1"}, "https://api.deepseek.com/v1", "k1"),
        ("deepseek-reasoner", {"llm_api_key": "k2"}, {"DEEPSEEK_API_KEY": "k1"}, "https://api.deepseek.com/v1", "k2"),
        ("gpt-5-mini", {}, {"OPENAI_API_KEY": " k3\n"}, "https://api.openai.com/v1", "k3"),
        ("gpt-5-mini", {"llm_base_url": "http://h/v1/"}, {"OPENAI_API_KEY": "k3"}, "http://h/v1", None),
        ("ollama:llama3:8b", {}, {"OPENAI_API_KEY": "k3"}, "http://localhost:11434/v1", None),
        ("vllm:qwen/qwen3", {}, {}, "http://localhost:8000/v1", None),
        ("llamacpp:any", {"llm_base_url": "http://gpu:9/v1"}, {}, "http://gpu:9/v1", None),
        ("my-own", {"llm_base_url": "http://gpu:9/v1"}, {}, "http://gpu:9/v1", None),
    ],
)
def test_a_name_stands_for_a_server(
    name: str, settings: dict[str, Any], environment: dict[str, str], url: str, authorized: str | None
) -> None:
    server = find_server(name, ModelSettings(**settings), environment)
    assert server.base_url == url
    assert (server.key.get_secret_value() if server.key else None) == authorized
    assert server.model == name.split(":", 1)[-1]
    assert authorized is None or authorized not in repr(server)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("gpt-5", "SUMO_ADV_LLM_API_KEY or OPENAI_API_KEY"),
        ("something", "SUMO_ADV_LLM_BASE_URL"),
        ("ollama:", "needs a name"),
        ("replay:none.jsonl", "cannot be read"),
    ],
)
def test_a_name_without_a_server_names_the_missing_setting(name: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        open_model(name, ModelSettings(), Ledger(), environment={})


def test_the_wait_can_be_interrupted() -> None:
    def press() -> None:
        while not server.asked:
            time.sleep(0.01)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with ModelServer([Hang()]) as server:
            threading.Thread(target=press, daemon=True).start()
            with pytest.raises(KeyboardInterrupt):
                answer(server)
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_environment_names_server_and_key_and_the_key_shows_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SUMO_ADV_LLM_BASE_URL", "http://gpu:8000/v1/")
    monkeypatch.setenv("SUMO_ADV_LLM_API_KEY", f" {KEY}\n")
    settings = load_settings(None)
    assert settings.llm_base_url == "http://gpu:8000/v1"
    assert settings.llm_api_key is not None and settings.llm_api_key.get_secret_value() == KEY
    assert KEY not in repr(settings) + str(settings) + settings.model_dump_json()
    for name, wrong, says in (
        ("SUMO_ADV_LLM_API_KEY", f"{KEY} {KEY}", "'llm_api_key' cannot be used: a key is one word"),
        ("SUMO_ADV_LLM_BASE_URL", f"http://me:{KEY}@gpu/v1", "'llm_base_url' cannot be used: a key does not belong"),
        ("SUMO_ADV_LLM_BASE_URL", "gpu:8000", "'llm_base_url' cannot be used: it should be an address such as"),
    ):
        with monkeypatch.context() as patched:
            patched.setenv(name, wrong)
            with pytest.raises(UsageError) as caught:
                load_settings(None)
        assert says in str(caught.value) and KEY not in str(caught.value)
