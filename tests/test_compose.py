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
    motion = (0.006, 0.2, 1e-4, 0.01, 1.5, 30.0, 12.0, 7.0)  # in the order of QUANTITIES
    assert forces.macro_force(*motion, p) == pytest.approx(-1.0 + 3.0 - 12.0, abs=1e-12)
    assert forces.micro_force(*motion, p) == pytest.approx(-2.0 * (0.006 - 0.05), abs=1e-15)
    assert forces.micro_actuator(*motion, p) == pytest.approx(-3.0, abs=1e-15)
    assert forces.macro_actuator(*motion, p) == 0.0
    assert forces.contact(1e-5, 0.01, p) == pytest.approx(0.75, abs=1e-15)


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
        "import sys; from stagectl import compose\n"
        "tables = [{'name': 'viscous_friction', 'acts_on': 'macro_force', 'damping_n_s_per_m': 5.0}]\n"
        "sys.stdin.readline()\n"
        "module = compose.forces_module(compose.structure_of(tables))\n"
        "print(module.macro_force(0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, compose.effect_parameters(tables)))"
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
