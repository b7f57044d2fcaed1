"""With real processes: an operator's program that hangs in a jog, and what of the way back is judged."""

import numpy as np
import pytest

from tests.faults.house import House
from tests.faults.mechanics import REST_M_PER_S
from tests.faults.unstopped import moved_at_rest
from tests.faults.witness import ENABLED, joined

TRIES = 3


def jogs(house: House) -> None:
    """Bring the stage into a jog; a hiccup of the host may stop it, and it gets another try."""
    for _ in range(TRIES):
        assert house.ready() == ""
        if house.set_off(0.1):
            return
        house.let_go()
    raise AssertionError("it does not move")


@pytest.mark.real_time
def test_a_client_that_is_gone_stops_the_stage_and_one_that_hung_is_obeyed_no_more(tmp_path_factory):
    house = House(tmp_path_factory.mktemp("house"))  # the path of a socket must be short
    try:
        house.daemon.state_is("idle")
        house.find_rig()
        for hangs in (False, True):
            jogs(house)
            house.vanish(half_open=hangs)
            house.daemon.state_is("fault")
            assert house.speed_m_per_s < REST_M_PER_S
            house.note_rest("fault")
            house.go_on_where_it_hung()
            assert house.accepted == []
        assert house.ready() == ""
        seen = house.look_back()
        from_t_ns, until_t_ns = house.unasked[-1]
        asked = np.searchsorted(seen["t_ns"], until_t_ns)
        assert asked - np.searchsorted(seen["t_ns"], from_t_ns) > 10
        assert (seen["states"][asked:, 0] == ENABLED).any()
        assert [moved_at_rest(seen, *window) for window in house.unasked] == [[] for _ in house.unasked]
        assert moved_at_rest(seen, from_t_ns, house.t_ns()) != []  # what was asked for would be seen
    finally:
        house.close()


def test_what_two_rigs_saw_lies_one_behind_the_other():
    def seen(first_ns, last_ns):
        t_ns = np.arange(first_ns, last_ns)
        return {"t_ns": t_ns, "states": np.zeros((t_ns.size, 2)), "sync_t_ns": t_ns[:3]}

    assert joined({}, seen(0, 5))["t_ns"].tolist() == [0, 1, 2, 3, 4]
    assert joined(seen(0, 5), seen(0, 7))["t_ns"].tolist() == [0, 1, 2, 3, 4, 5, 6]
    two = joined(seen(0, 3), seen(5, 7))
    assert two["t_ns"].tolist() == [0, 1, 2, 5, 6]
    assert two["states"].shape == (5, 2)
