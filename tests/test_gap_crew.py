"""Whoever does the work of a gap search, the answer is the same: this thread, two threads, a cluster of two workers."""

import dataclasses
import os
import socket
import threading

import distributed
import pytest

from bench.blind_sets import load_set
from stagectl.commands import gap
from stagectl.errors import LinkError, RequestError
from stagectl.gap.believed import load_believed
from stagectl.gap.crew import Dask, Serial, Threads, crew_of, one_blas_thread
from stagectl.gap.workflow import find, find_many
from tests.blind import generate
from tests.hill_in_the_guide import HILL, HILL_AXIS, hill_log

SEED, DURATION_S = 117, 1.5  # two axes that touch; one sensor reads late, which moves the joint
LOCAL = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}


@pytest.fixture(scope="module")
def blind(tmp_path_factory):
    """A small set as a user hands it over."""
    folder = tmp_path_factory.mktemp("set")
    generate.write(generate.draw(SEED, None, DURATION_S), folder)
    return load_set(folder)


@pytest.fixture(scope="module")
def serial(blind):
    """What one thread finds in it."""
    return _found(blind, Serial())


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes on this machine."""
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **LOCAL) as local:
        yield local


def _found(blind, crew):
    return find(blind.believed, blind.logs[:1], blind.logs[1:2], nulls_count=20, crew=crew)


def test_two_threads_find_the_same_to_the_last_bit(blind, serial):
    with Threads(2) as crew:
        assert dataclasses.asdict(_found(blind, crew)) == dataclasses.asdict(serial)


def test_who_has_nothing_to_do_helps_with_a_part_of_a_task():
    with Threads(2) as crew:
        both = threading.Barrier(2, timeout=10.0)  # passes only where two are there at a time
        crew.here(lambda _: crew.helped(lambda _: both.wait(), range(2)), range(1))
        assert crew.helped(lambda number: 10 * number, range(5)) == [0, 10, 20, 30, 40]


def test_where_all_are_busy_nobody_helps():
    begun, ended = threading.Barrier(2, timeout=10.0), threading.Barrier(2, timeout=10.0)

    def task(_: int) -> bool:
        begun.wait()
        threads = crew.helped(lambda _: threading.get_ident(), range(4))
        ended.wait()  # both are at work until both have asked
        return set(threads) == {threading.get_ident()}

    with Threads(2) as crew:
        assert crew.here(task, range(2)) == [True, True]
        with pytest.raises(ZeroDivisionError):
            crew.helped(lambda number: 1 // number, range(2))
        assert crew.helped(lambda _: threading.get_ident(), range(2)) != [threading.get_ident()] * 2  # helps again
    assert crew.helped(lambda _: threading.get_ident(), range(2)) == [threading.get_ident()] * 2  # and not any more


def test_a_cluster_finds_the_same_to_the_last_bit(blind, serial, cluster):
    assert serial.named, serial.trace  # something was searched, so something had to travel
    with Dask(cluster.scheduler_address) as crew:
        assert dataclasses.asdict(_found(blind, crew)) == dataclasses.asdict(serial)


def _process(number: int) -> tuple[int, int]:
    return number, os.getpid()


def test_tasks_of_a_cluster_are_done_elsewhere_and_come_back_in_order(cluster):
    with Dask(cluster.scheduler_address) as crew:
        done = crew.map(_process, (), range(20))
    assert [number for number, _ in done] == list(range(20))
    assert os.getpid() not in {process for _, process in done}


def test_many_sets_are_found_in_their_order_and_a_wrong_one_stands_in_its_place(blind, serial, cluster):
    log, other = blind.logs[:2]
    sets = [([log], [log]), ([log], [other])]
    with Dask(cluster.scheduler_address) as crew:
        wrong, right = find_many(blind.believed, sets, crew, nulls_count=20)
    assert right == serial
    assert isinstance(wrong, RequestError)
    assert "both training and holdout" in str(wrong)


# ---- a law of the user's own --------------------------------------------------------------------------------------


def test_a_users_own_law_goes_to_the_workers_as_text(tmp_path, cluster):
    (tmp_path / "hill.py").write_text(HILL)
    (tmp_path / "axis.toml").write_text(HILL_AXIS)
    believed = load_believed(tmp_path / "axis.toml")
    logs = [hill_log("run 1", 1, 3000), hill_log("run 2", 2, 3000)]
    with Dask(cluster.scheduler_address) as crew:
        findings = find(believed, logs[:1], logs[1:], nulls_count=20, crew=crew)
        (again,) = find_many(believed, [(logs[:1], logs[1:])], crew, nulls_count=20)
    assert [effect.name for effect in findings.named] == ["scratch_in_the_guide"], findings.trace
    assert again == findings


# ---- what is refused, and what stays behind -----------------------------------------------------------------------


@pytest.mark.parametrize("address", ["nonsense", "udp://127.0.0.1:8786"])
def test_an_address_that_is_none_is_said_with_what_would_be_one(address):
    with pytest.raises(LinkError, match=rf"--dask {address}: no dask scheduler .* such as tcp://"):
        Dask(address)


def test_a_server_that_says_nothing_is_not_waited_for():
    with socket.create_server(("127.0.0.1", 0)) as mute:
        address = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        with pytest.raises(LinkError, match=rf"{address}: no dask scheduler answers there within 0.3 s"):
            Dask(address, answer_s=0.3)


def test_a_cluster_without_workers_is_said():
    with (
        distributed.LocalCluster(n_workers=0, **LOCAL) as empty,
        pytest.raises(LinkError, match=r"has no worker after 0\.3 s; start one with `dask worker tcp://"),
    ):
        Dask(empty.scheduler_address, answer_s=0.3)


def test_no_worker_at_all_is_refused():
    with pytest.raises(RequestError, match="0 workers do nothing; give 1 or more"):
        crew_of(0)


def test_workers_of_this_machine_and_a_cluster_exclude_each_other(tmp_path):
    with pytest.raises(RequestError, match="give one of them"):
        gap.search(None, "axis", [], [], tmp_path, tmp_path, 0, 2, "tcp://127.0.0.1:8786")


def test_after_an_interrupt_nothing_begins_any_more():
    begun, count = [], 500
    two_at_work, over = threading.Event(), threading.Event()

    def task(number: int) -> None:
        begun.append(number)
        if number == 0:
            assert two_at_work.wait(10.0)
            raise KeyboardInterrupt
        two_at_work.set()
        assert over.wait(10.0)

    with pytest.raises(KeyboardInterrupt), Threads(2) as crew:
        crew.here(task, range(count))
    over.set()
    for thread in threading.enumerate():
        if thread.name.startswith("gap_"):
            thread.join(10.0)
            assert not thread.is_alive()
    assert set(begun) <= {0, 1, 2}  # the thread that was interrupted may have begun another before it was told


def test_blas_gets_its_threads_back_when_the_last_one_ends():
    from threadpoolctl import threadpool_info

    def counts():
        return [row["num_threads"] for row in threadpool_info() if row["user_api"] == "blas"]

    before = counts()
    with one_blas_thread():
        with one_blas_thread():
            assert set(counts()) == {1}
        assert set(counts()) == {1}
    assert counts() == before
