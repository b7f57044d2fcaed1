"""The service's log as clients read it: numbered, the newest kept, and never larger than it was at the start."""

import tracemalloc

from stagectl.service.service_log import KEPT_BYTES, KEPT_COUNT, ServiceLog


def said(log: ServiceLog, count: int, text: str = "") -> None:
    for number in range(1, count + 1):
        log.say("command", text, name="move", key=f"key-{number}", body={"target_m": 0.1, "law": None})


def test_the_newest_are_kept_and_numbered():
    log = ServiceLog(None)
    assert (log.last(5), log.after(0, 5)) == ([], [])
    said(log, KEPT_COUNT + 50)
    assert [entry.number for entry in log.last(2)] == [KEPT_COUNT + 49, KEPT_COUNT + 50]
    assert [entry.number for entry in log.after(0, 2)] == [51, 52]
    assert [entry.number for entry in log.after(KEPT_COUNT + 49, 9)] == [KEPT_COUNT + 50]
    assert len(log.last(10_000)) == KEPT_COUNT
    newest = log.last(1)[0]
    assert (newest.event, newest.fields["key"]) == ("command", f"key-{KEPT_COUNT + 50}")
    assert newest.fields["body"] == {"target_m": 0.1, "law": None}


def test_long_texts_push_old_ones_out_and_none_is_torn():
    log = ServiceLog(None)
    said(log, 300, "x" * 10_000)
    kept = log.last(300)
    assert 90 < len(kept) <= KEPT_BYTES // 10_000
    assert all(entry.text == "x" * 10_000 for entry in kept)
    assert [entry.number for entry in log.after(0, 300)] == [entry.number for entry in kept]


def test_what_is_larger_than_an_entry_may_be_is_cut_for_clients():
    log = ServiceLog(None)
    log.say("fault", "\u00b5" * 50_000, values={"a": 1.0})
    (entry,) = log.last(1)
    assert entry.text == "\u00b5" * 4000
    assert entry.fields == {}


def test_it_takes_no_more_memory_as_it_goes_on():
    log = ServiceLog(None)
    tracemalloc.start()
    try:
        said(log, 10)
        before, _ = tracemalloc.get_traced_memory()
        said(log, 2 * KEPT_COUNT)
        assert tracemalloc.get_traced_memory()[0] - before < 20_000
    finally:
        tracemalloc.stop()
