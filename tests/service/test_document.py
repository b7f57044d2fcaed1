"""The OpenAPI document, fuzzed against the API of a stage in virtual time: nothing fails, and nothing moves."""

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import CHECKS, load_all_checks

from stagectl.service import messages
from stagectl.service.access import Access
from stagectl.service.api import application
from stagectl.service.listener import Listener
from stagectl.service.places import listen_tcp
from tests.service.test_stage_loop import Bench

load_all_checks()
_NAMES = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_schema_conformance",
    "negative_data_rejection",
)
_CHECKS = [CHECKS.get_one(name) for name in _NAMES]
_CASES_COUNT = 8  # of every operation, with data that fit and with data that don't


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A stage that stands in virtual time, and its API on a port: (bench, URL, document)."""
    bench = Bench(tmp_path_factory.mktemp("fuzzed"))
    bench.until(lambda: bench.loop._state == "idle")
    bench.loop.step()
    app = application(bench.desk, bench.log, bench.figures, bench.settings.runs_root, "0")
    listening = listen_tcp(0)
    url = f"http://127.0.0.1:{listening.getsockname()[1]}"
    listener = Listener([(listening, Access(app, None))])
    listener.start()
    yield bench, url, app.openapi()
    listener.close()
    bench.loop.leave()
    bench.loop.run()


@pytest.mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE])
def test_no_request_without_a_lease_moves_or_breaks_anything(served, mode):
    bench, url, document = served
    nodes = bench.loop._stage.backend.rig.nodes
    tried = set()
    for result in schemathesis.openapi.from_dict(document).get_all_operations():
        operation = result.ok()

        @settings(
            max_examples=_CASES_COUNT,
            deadline=None,
            database=None,
            derandomize=True,
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy(generation_mode=mode))
        def once(case):
            tried.add(case.operation.label)
            if "wait_s" in (case.query or {}):
                case.query["wait_s"] = 0
            case.call_and_validate(base_url=url, checks=_CHECKS, timeout=10)
            bench.loop.step()
            assert {node.drive.state.name for node in nodes} == {"SWITCH_ON_DISABLED"}

        try:
            once()
        except Unsatisfiable:  # no data can be wrong where there is none to give
            assert mode is GenerationMode.NEGATIVE
    assert {"POST /v1/move", "PUT /v1/jogging/{key}", "POST /v1/lease"} <= tried
    for _ in range(3):
        bench.loop.step()
    assert bench.status.state == "idle"
    assert bench.desk.stop_asked is False


def test_the_document_says_what_the_client_needs(served):
    document = served[2]
    for name in ("arm", "home", "move", "jog", "identify", "acknowledge", "backend", "stop"):
        assert "post" in document["paths"][f"/v1/{name}"]
    assert set(messages.Status.model_fields) == set(document["components"]["schemas"]["Status"]["properties"])
