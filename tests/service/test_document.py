"""The OpenAPI document, fuzzed against the API of a stage in virtual time.

Nothing fails. Without a lease nothing moves; with one, nothing beyond the limits.
"""

import asyncio
import copy
import itertools
import json

import numpy as np
import pytest
import schemathesis
import websockets
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
from tests.struck_stage import home_by_truth

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
_FEW_COUNT = 2  # with the lease, of what moves nothing, or doesn't fit
_NO_FAILURE = [CHECKS.get_one(name) for name in _NAMES[:4]]  # with a lease put in, wrong data may be right


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


OPERATION_S = 1.2
"""After so long in the stage's own time an operator has seen enough of what was asked for."""

TRAVEL_M, SPEED_M_PER_S = 0.2, 0.6
"""A little more than the stage has; of numbers from all that the document allows hardly one could be done."""

NEAR = {
    "Move": {"target_m": TRAVEL_M},
    "JogBy": {"distance_m": TRAVEL_M},
    "JogAt": {"velocity_m_per_s": SPEED_M_PER_S},
    "Segment": {"target_m": TRAVEL_M, "pass_velocity_m_per_s": SPEED_M_PER_S},
}
OVERSHOOT_M = 1e-4

MOTIONS = {f"POST /v1/{name}" for name in ("home", "move", "jog", "scan", "follow", "stop")}
MOTIONS |= {"PUT /v1/jogging/{key}", "PUT /v1/setpoints"}
TABLE = r"^t_s,position_m\n0,0\n0\.[1-9],-?0\.[01][0-9]\n[1-9],0\n$"


def of_the_stage_s_size(document):
    """Return the document with numbers near what a stage can do, or just can't."""
    near = copy.deepcopy(document)
    schemas = near["components"]["schemas"]
    for name, fields in NEAR.items():
        for field, most in fields.items():
            schemas[name]["properties"][field] |= {"minimum": -most, "maximum": most}
    schemas["Follow"]["properties"]["text"] |= {"pattern": TABLE, "maxLength": 100}
    setpoints = schemas["Setpoints"]["properties"]
    setpoints["position_m"]["items"] |= {"minimum": -5e-3, "maximum": 5e-3}
    setpoints["period_s"]["enum"] = [0.1, 0.01]
    return near


class Operated:
    """A homed stage whose operator renews the lease, and arms it again whatever was asked for.

    Leases run out by the stage's own time; what is under way after a while is stopped.
    """

    def __init__(self, bench):
        self.bench, self._until_s = bench, 0.0
        self._stage = bench.loop._stage
        bench.now_s = self._stage.backend.wire.t_ns * 1e-9
        bench.hold_as_homed_by_truth()
        self._before, self._stage._progress = self._stage._progress, self._progress
        self.reached_m, self.fastest_m_per_s = [], 0.0

    def _progress(self, what, share):
        self.bench.now_s = self._stage.backend.wire.t_ns * 1e-9
        if self.bench.now_s > self._until_s:
            self.bench.desk.ask_to_stop("seen enough")
        self._before(what, share)

    def is_armed(self):
        """Have it so, with a lease that lasts."""
        bench, self._until_s = self.bench, np.inf
        bench.until(lambda: bench.status.state in ("armed", "idle") and not bench.desk.stop_asked)
        bench.loop.step()
        if bench.desk.lease_state() is None:  # it was given back
            bench.take()
        bench.desk.renew_lease(bench.token)
        plant = self._stage.backend.rig.plant_state()
        if bench.status.state == "idle":
            if not bench.loop._homed:  # a homing was asked for, and took longer
                home_by_truth(self._stage, plant)
                bench.loop._homed = True
            assert bench.do("arm", messages.Arm()).stop == "FINISHED"
            plant = self._stage.backend.rig.plant_state()
        self._zero_m = plant["macro_position_m"] - float(self._stage.status()["macro_position_m"])  # of the last homing
        self._begun_t_ns = self._stage.backend.wire.t_ns
        self._until_s = self._begun_t_ns * 1e-9 + OPERATION_S

    def ends(self, label, profile):
        """Carry out what was asked for, and judge what was true meanwhile; a homing finds its zero only at its end."""
        bench = self.bench
        bench.loop.step()
        bench.until(lambda: not bench.desk.stop_asked and bench.status.command is None)
        assert bench.status.fault is None
        truth = self._stage.backend.truth()
        since = truth["t_ns"] >= self._begun_t_ns
        fastest_m_per_s = np.abs(truth["macro_velocity_m_per_s"][since]).max(initial=0.0)
        assert fastest_m_per_s <= profile.macro.velocity_limit_m_per_s
        self.fastest_m_per_s = max(fastest_m_per_s, self.fastest_m_per_s)
        if label != "POST /v1/home":
            low_m, high_m = profile.macro.travel_m
            for at_m in np.sort(truth["macro_position_m"][since] - self._zero_m)[[0, -1]] if since.any() else ():
                assert low_m - OVERSHOOT_M <= at_m <= high_m + OVERSHOOT_M
                self.reached_m.append(at_m)

    def leave(self):
        self._stage._progress = self._before
        self.bench.desk.ask_to_stop("the end")
        self.bench.until(lambda: self.bench.status.state == "idle")


@pytest.fixture(scope="module")
def operated(served):
    """That stage, with an operator."""
    one = Operated(served[0])
    yield one
    one.leave()


@pytest.mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE])
def test_no_request_with_the_lease_moves_anything_beyond_travel_and_speed(served, operated, single_profile, mode):
    bench, url, document = served
    if mode is GenerationMode.POSITIVE:
        document = of_the_stage_s_size(document)
    accepted, numbers = set(), itertools.count()
    for result in schemathesis.openapi.from_dict(document).get_all_operations():
        operation = result.ok()
        if operation.method == "get":
            continue

        @settings(
            max_examples=_CASES_COUNT if operation.label in MOTIONS and mode.is_positive else _FEW_COUNT,
            deadline=None,
            database=None,
            derandomize=True,
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy(generation_mode=mode))
        def once(case):
            operated.is_armed()
            label = case.operation.label
            headers = {"Stagectl-Lease": bench.token}
            if "wait_s" in (case.query or {}):
                case.query["wait_s"] = 0
            if mode is GenerationMode.POSITIVE:
                case.headers.pop("Idempotency-Key", None)  # one that was used for something else is refused
                if label == "PUT /v1/jogging/{key}":
                    case.path_parameters["key"] = bench.desk.begin_jog(
                        messages.BeginJog(), f"jog-{next(numbers)}", bench.token
                    ).key
                if label == "PUT /v1/setpoints":
                    begins_m = bench.status.positions.setpoint_position_m
                    positions = [begins_m, *(begins_m + one for one in case.body["position_m"])]
                    case.body |= {"first_number": 0, "position_m": positions[:2000]}
            answer = case.call_and_validate(base_url=url, headers=headers, checks=_NO_FAILURE, timeout=10)
            if answer.status_code < 300:
                accepted.add(label)
            operated.ends(label, single_profile)

        try:
            once()
        except Unsatisfiable:  # no data can be wrong where there is none to give
            assert mode is GenerationMode.NEGATIVE
    if mode is GenerationMode.POSITIVE:  # it was a test of something
        assert accepted >= MOTIONS
    for target_m in single_profile.macro.travel_m:
        operated.is_armed()
        assert bench.do("move", messages.Move(target_m=target_m)).state == "done"
        operated.ends("move", single_profile)
    assert np.ptp(operated.reached_m) == pytest.approx(np.ptp(single_profile.macro.travel_m), abs=1e-4)
    assert operated.fastest_m_per_s > 0.4


HOSTILE_FRAMES = [
    "",
    "{",
    "[" * 4000,
    "NaN",
    '{"target_m": NaN, "velocity_m_per_s": 1e999}',
    '{"status": {"state": "idle"}, "samples": null}',
    "PUT /v1/jogging/jog-0 HTTP/1.1\r\n\r\n",
    "x" * 1_000_000,
    b"",
    b"\xff\x00" * 2000,
    b"\x00" * 1_000_000,
]


def test_nothing_that_is_said_to_the_stream_is_listened_to(served, operated):
    """A frame beyond the limit closes that stream; everybody else's goes on, and so does the operator."""
    bench, url, _ = served
    operated.is_armed()
    holds_m = bench.status.positions.setpoint_position_m
    address = url.replace("http", "ws") + "/v1/stream"

    async def say(frame):
        async with websockets.connect(f"{address}?rate_hz=30", max_size=None) as hostile:
            await hostile.send(frame)
            try:
                for _ in range(3):
                    assert json.loads(await asyncio.wait_for(hostile.recv(), 10.0))["status"]["state"] == "armed"
            except websockets.ConnectionClosed as closed:
                return closed.rcvd.code
        return None

    async def say_all():
        async with websockets.connect(address, max_size=None, max_queue=None) as other:
            codes = [await say(frame) for frame in HOSTILE_FRAMES]
            assert json.loads(await asyncio.wait_for(other.recv(), 10.0))["samples"]["columns"]
        return codes

    codes = asyncio.run(say_all())
    assert codes == [1009 if len(frame) > 100_000 else None for frame in HOSTILE_FRAMES]
    for query in ("rate_hz=nan", "rate_hz=inf", "rate_hz=1e9", "rate_hz=-1", "rate_hz=%00", "rate_hz=" + "9" * 4000):
        with pytest.raises(websockets.InvalidStatus) as refused:
            asyncio.run(opened(f"{address}?{query}"))
        assert refused.value.response.status_code < 500
    bench.loop.step()
    assert bench.status.state == "armed"
    assert bench.desk.is_lease_token(bench.token)
    assert bench.status.command is None
    assert bench.status.positions.setpoint_position_m == holds_m


async def opened(address):
    """Open a stream, and hear nothing."""
    async with websockets.connect(address):
        pass
