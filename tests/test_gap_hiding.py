"""What the gap demo hides: one effect beside those that the profile knows, another one for another seed."""

import pytest

from sim_backend.machine import load_machine, machine_path_for
from stagectl.gap import hiding
from stagectl.profile import load_profile


@pytest.mark.parametrize("name", ["oled-printer", "single-axis"])
def test_the_machine_has_one_effect_that_the_profile_lacks(name, tmp_path):
    profile = load_profile(name)
    known = [(row["name"], row["acts_on"]) for row in profile.effects]
    hidden = hiding.drawn(1, profile.micro is not None)
    file = tmp_path / "machine.toml"
    file.write_text(hiding.with_hidden(machine_path_for(name).read_text(), known, hidden))
    machine = load_machine(file)
    assert [dict(row) for row in machine.effects][-1] == hidden
    assert all((row["name"], row["acts_on"]) in known for row in list(machine.effects)[:-1])
    assert machine.macro == load_machine(name).macro


def test_a_seed_draws_one_effect():
    assert hiding.drawn(4, True) == hiding.drawn(4, True)
    assert len({str(hiding.drawn(seed, False)) for seed in range(10)}) == 10
    assert {hiding.drawn(seed, False)["name"] for seed in range(10)} == {"coulomb_friction", "cogging"}
