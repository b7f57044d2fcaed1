"""Composed modules: one a structure, whatever the values; what may not act there is refused."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stagectl import compose
from stagectl.compiled import CACHE_FOLDER
from stagectl.errors import ProfileError
from stagectl.plant import MEMORY_COUNT
from tests.effect_numbers import table
from tests.stage import Bench

VISCOUS = {"name": "viscous_friction", "acts_on": "macro_force", "damping_n_s_per_m": 5.0}
CABLE = {"name": "cable_spring", "acts_on": "micro_force", "stiffness_n_per_m": 2.0, "anchor_m": 0.05}
COGGING = {"name": "cogging", "acts_on": "macro_force", "amplitude_n": 3.0, "pitch_m": 0.024, "phase_rad": 0.0}
REACTION = {"name": "micro_reaction", "acts_on": "macro_force", "fraction_ratio": 1.0}
CONTACT = {"name": "contact_damping", "acts_on": "contact", "damping_n_s_per_m": 75.0}
ERROR = {"name": "force_constant_error", "acts_on": "micro_actuator", "error_ratio": -0.1}


def test_values_do_not_change_the_module():
    one = compose.plant_module([VISCOUS, CABLE])
    other = compose.plant_module([VISCOUS | {"damping_n_s_per_m": 9.0}, CABLE | {"anchor_m": -1.0}])
    assert one is other
    assert compose.forces_module(compose.structure_of([VISCOUS])) is compose.forces_module(
        compose.structure_of([VISCOUS | {"damping_n_s_per_m": 6.0}])
    )


@pytest.mark.parametrize(
    "effects", [[VISCOUS], [CABLE, VISCOUS], [VISCOUS, CABLE | {"acts_on": "macro_force"}], [VISCOUS, CABLE, CABLE]]
)
def test_another_structure_is_another_module(effects):
    assert compose.plant_module(effects) is not compose.plant_module([VISCOUS, CABLE])


def test_parameters_stand_in_the_order_of_tables_and_declarations():
    shuffled = {"phase_rad": 0.5, "pitch_m": 0.024, "acts_on": "macro_force", "amplitude_n": 3.0, "name": "cogging"}
    values = compose.effect_parameters([CABLE, shuffled, VISCOUS])
    assert values.dtype == np.float64
    assert values.tolist()[:-1] == [2.0, 0.05, 3.0, 0.024, 0.5, 5.0]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (VISCOUS | {"name": "viscous"}, ["effects[1].name", "'viscous'", "viscous_friction"]),
        ({"acts_on": "macro_force"}, ["effects[1].name", "None"]),
        (VISCOUS | {"acts_on": "contact"}, ["effects[1]", "can't act on 'contact'", "macro_force"]),
        (REACTION | {"acts_on": "micro_force"}, ["micro_reaction", "can't act on 'micro_force'"]),
        (VISCOUS | {"level_n": 1.0}, ["takes the parameters", "level_n"]),
        ({"name": "viscous_friction", "acts_on": "macro_force"}, ["takes the parameters", "damping_n_s_per_m"]),
    ],
)
def test_what_cannot_act_there_is_refused(table, words):
    for call in (compose.plant_module, compose.effect_parameters, compose.structure_of):
        with pytest.raises(ProfileError) as caught:
            call([COGGING, table])
        for word in words:
            assert word in str(caught.value)


def test_each_place_sums_its_own_effects():
    effects = [VISCOUS, CABLE, COGGING, REACTION, CONTACT, ERROR]
    forces = compose.forces_module(compose.structure_of(effects))
    p = compose.effect_parameters(effects)
    nothing = np.zeros(0)
    motion = (0.006, 0.2, 0.5, 70.0, 1e-4, 0.01, 1.5, 30.0, 12.0, 7.0, 1e-4)  # in the order of QUANTITIES
    assert forces.macro_force(*motion, nothing, p) == pytest.approx(-1.0 + 3.0 - 12.0, abs=1e-12)
    assert forces.micro_force(*motion, nothing, p) == pytest.approx(-2.0 * (0.006 - 0.05), abs=1e-15)
    assert forces.micro_actuator(*motion, nothing, p) == pytest.approx(-3.0, abs=1e-15)
    assert forces.macro_actuator(*motion, nothing, p) == 0.0
    assert forces.contact(1e-5, 0.01, 1e4, 1.0, 7.0, 1e-4, nothing, p) == pytest.approx(0.75, abs=1e-15)


def test_the_other_places_sum_their_own_effects():
    effects = [
        table("linear_stiffness", "joint", stiffness_n_per_m=500.0),
        table("backlash_width_change", change_m=4e-6),
        table("backlash_centre_shift", shift_m=1e-6),
        table("amplifier_dead_band", "micro_command", half_width_a=0.02),
        table("scale_error", "macro_sensor", error_ppm=2.0),
        table("scale_error", "end_sensor", error_ppm=-1.0),
    ]
    forces = compose.forces_module(compose.structure_of(effects))
    p, nothing = compose.effect_parameters(effects), np.zeros(0)
    assert forces.joint(2e-3, 0.0, 0.0, 0.0, nothing, p) == pytest.approx(-1.0, rel=1e-15)
    assert forces.contact_edge(1.0, 0.0, nothing, p) == pytest.approx(3e-6, rel=1e-15)
    assert forces.contact_edge(-1.0, 0.0, nothing, p) == pytest.approx(1e-6, rel=1e-15)
    assert forces.micro_command(0.05, 0.0, 0.0, 1e-4, nothing, p) == pytest.approx(-0.02, rel=1e-15)
    assert forces.macro_command(0.05, 0.0, 0.0, 1e-4, nothing, p) == 0.0
    assert forces.macro_sensor(0.3, 0.0, 0.0, 0.0, 0.0, nothing, p) == pytest.approx(6e-7, rel=1e-15)
    assert forces.end_sensor(0.3, 0.0, 0.0, 0.0, 0.0, nothing, p) == pytest.approx(-3e-7, rel=1e-15)


def test_each_effect_has_a_memory_of_its_own():
    """Two of a kind on one axis, a third with three numbers: nobody writes where another reads."""
    effects = [
        table("dahl_friction", "macro_force", slip_m=1e-6),
        VISCOUS,
        table("flexible_mode", "macro_force"),
        table("dahl_friction", "macro_force", slip_m=1e-3),
    ]
    forces = compose.forces_module(compose.structure_of(effects))
    p, memory = compose.effect_parameters(effects), np.zeros(8)
    forces.macro_force(0.0, 1e-3, 0.5, 70.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-3, memory, p)
    assert memory[0] == pytest.approx(0.63212055882855768, rel=1e-15)  # 1 - 1/e
    assert memory[3] == pytest.approx(0.1 / 0.9 * 0.5, rel=0.1)  # F / m of the mode, which hardly began to swing
    assert memory[4] == pytest.approx(1e-3, rel=1e-3)  # of the second slip length a thousandth
    assert np.all(memory[5:] == 0.0)


def test_a_law_can_undo_what_acts_at_once():
    effects = [table("command_delay", "macro_command"), table("amplifier_dead_band", "macro_command", half_width_a=0.1)]
    forces = compose.forces_module(compose.structure_of(effects))
    p, memory = compose.effect_parameters(effects), np.zeros(MEMORY_COUNT)
    assert forces.macro_command(1.0, 0.0, 0.0, 1e-4, memory, p) == pytest.approx(-1.1, rel=1e-12)
    assert memory[1] == 1.0  # one change is on its way
    before = memory.copy()
    assert forces.macro_command_at_once(1.0, 0.0, 0.0, 1e-4, memory, p) == pytest.approx(-0.1, rel=1e-15)
    assert memory.tobytes() == before.tobytes()


def test_more_memory_than_there_is():
    delay = table("command_delay", "macro_command")
    compose.structure_of([delay] * 3)
    with pytest.raises(ProfileError, match="effects remember 72 numbers, and a machine has room for 64; remove some"):
        compose.structure_of([delay] * 4)


def test_an_actuator_effect_is_felt_by_mass_and_reaction_alike():
    bench = Bench([VISCOUS | {"damping_n_s_per_m": 0.0}, REACTION, CONTACT, ERROR])
    bench.advance(0.1, micro_a=1.0)  # 10 N/A, a tenth of it missing: 9 N
    assert bench["micro_force_n"] == pytest.approx(9.0, rel=1e-12)
    assert 40.0 * bench["end_acceleration_m_per_s2"] == pytest.approx(9.0, rel=1e-12)
    assert 70.0 * bench["macro_acceleration_m_per_s2"] == pytest.approx(-9.0, rel=1e-12)


def test_a_damaged_module_in_the_cache_is_written_anew():
    source = '"""A generated module that was cut off on its way to the disk."""\nVALUE_RATIO = 3.5\n'
    first = compose.generated_module("test", source)
    path = Path(first.__file__)
    assert path.parent == CACHE_FOLDER / "generated"
    path.write_text(source[:70])
    del sys.modules[first.__name__]
    again = compose.generated_module("test", source)
    assert again.VALUE_RATIO == 3.5
    assert path.read_text() == source
    assert compose.generated_module("test", source) is again


def test_two_processes_compose_the_same_machine_at_once(tmp_path):
    text = (
        "import sys; import numpy as np; from stagectl import compose\n"
        "tables = [{'name': 'viscous_friction', 'acts_on': 'macro_force', 'damping_n_s_per_m': 5.0}]\n"
        "sys.stdin.readline()\n"
        "module = compose.forces_module(compose.structure_of(tables))\n"
        "motion = (0.0, 0.2, *[0.0] * 9)\n"
        "print(module.macro_force(*motion, np.zeros(0), compose.effect_parameters(tables)))"
    )
    environment = os.environ | {"STAGECTL_CACHE": str(tmp_path)}
    children = [
        subprocess.Popen(
            [sys.executable, "-c", text], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    for child in children:  # both have imported everything when they are let go
        child.stdin.write("\n")
        child.stdin.flush()
    assert [child.communicate(timeout=120)[0].strip() for child in children] == ["-1.0", "-1.0"]
    assert [child.returncode for child in children] == [0, 0]
    generated = list(tmp_path.glob("*/generated/*"))
    assert [path.suffix for path in generated if path.is_file()] == [".py"]


def test_advance_ends_at_the_instant_asked_for():
    bench = Bench([VISCOUS, REACTION, CONTACT], {"micro_mass_kg": 40.0})
    bench.state["macro_velocity_m_per_s"] = 0.1
    for until_s in (1e-3, 1.000001e-3, 0.5, 0.5 + 1.0 / 3.0):
        bench.advance(until_s)
        assert bench["t_s"] == until_s
    before = bench.state.copy()
    for until_s in (bench["t_s"], 0.1, float("nan")):  # nothing to do, past, unknown
        bench.advance(until_s)
        assert bench.state.tobytes() == before.tobytes()


def test_substeps_are_equal_and_no_longer_than_asked():
    bench = Bench([VISCOUS, REACTION, CONTACT])
    for span_s, longest_s, expected_s in (
        (1e-3, 50e-6, 50e-6),
        (575e-6, 300e-6, 287.5e-6),
        (425e-6, 50e-6, 425e-6 / 9),
    ):
        bench.advance(bench["t_s"] + span_s, longest_s=longest_s)
        assert bench["decay_dt_s"] == pytest.approx(expected_s, rel=1e-9)
