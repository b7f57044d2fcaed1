"""The machine against mechanics worked by hand: Newton, energy, statics of (1)-(5), motors, stops, order, noise."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stagectl import plant
from stagectl.plant import BRIDGE_OFF, BRIDGE_SHORTED
from tests.effect_numbers import table
from tests.stage import HARD, Bench, place

OFF = (BRIDGE_OFF, BRIDGE_OFF)
JOINT = {  # the rig's fit of Kang et al. 2023, section 6.1, and the spring of the "realistic" set
    "left_m": 25.4e-6,
    "right_m": 176e-6,
    "left_stiffness_n_per_m": 13.2e3,
    "right_stiffness_n_per_m": 9.87e3,
    "spring_n_per_m": 500.0,
}
MACRO_MOTOR = {  # the linear motor of the default machine
    "macro_force_constant_n_per_a": 99.0,
    "macro_back_emf_v_s_per_m": 99.0,
    "macro_resistance_ohm": 2.75,
    "macro_inductance_h": 9.37e-3,
    "macro_supply_v": 300.0,
    "macro_current_limit_a": 20.0,
}
MICRO_MOTOR = {  # its voice coil
    "micro_force_constant_n_per_a": 30.3,
    "micro_back_emf_v_s_per_m": 30.3,
    "micro_resistance_ohm": 0.76,
    "micro_inductance_h": 2.52e-3,
    "micro_supply_v": 48.0,
    "micro_current_limit_a": 6.0,
}


def effects(viscous=0.0, reaction=1.0, contact=0.0) -> list[dict]:
    """Return the profile's three effects, so that all benches here share one compiled plant."""
    return [
        {"name": "viscous_friction", "acts_on": "macro_force", "damping_n_s_per_m": viscous},
        {"name": "micro_reaction", "acts_on": "macro_force", "fraction_ratio": reaction},
        {"name": "contact_damping", "acts_on": "contact", "damping_n_s_per_m": contact},
    ]


def momentum(bench: Bench) -> float:
    masses = bench.parameters
    macro = float(masses["macro_mass_kg"][0]) * bench["macro_velocity_m_per_s"]
    return macro + float(masses["micro_mass_kg"][0]) * bench["end_velocity_m_per_s"]


def energy(bench: Bench) -> float:
    """Return kinetic energy and that of spring, contact and base spring, J."""
    q = {name: float(bench.parameters[name][0]) for name in bench.parameters.dtype.names}
    x_b = bench["macro_position_m"] - bench["end_position_m"]
    total = 0.5 * q["macro_mass_kg"] * bench["macro_velocity_m_per_s"] ** 2
    total += 0.5 * q["micro_mass_kg"] * bench["end_velocity_m_per_s"] ** 2
    total += 0.5 * q["spring_n_per_m"] * x_b**2 + 0.5 * q["base_spring_n_per_m"] * bench["macro_position_m"] ** 2
    total += 0.5 * q["right_stiffness_n_per_m"] * max(x_b - q["right_m"], 0.0) ** 2
    total += 0.5 * q["left_stiffness_n_per_m"] * max(-x_b - q["left_m"], 0.0) ** 2
    return total


# ---- Newton ----------------------------------------------------------------------------------------------------


def test_inner_forces_leave_the_momentum_alone():
    bench = Bench(effects(reaction=1.0, contact=75.0), JOINT | {"damping_n_s_per_m": 5.0} | MICRO_MOTOR)
    place(bench.state, macro_velocity_m_per_s=1e-3, end_velocity_m_per_s=-1e-3 * 70.0 / 40.0)
    touched = set()
    for k in range(600):
        bench.advance((k + 1) * 5e-3, micro_a=0.3 * (-1) ** (k // 40))
        touched.add(bench["contact_side"])
        assert abs(momentum(bench)) < 1e-13
    assert touched == {-1.0, 0.0, 1.0}  # the motion met both contacts and the gap


def test_without_the_reaction_the_voice_coil_pushes_the_room():
    bench = Bench(effects(reaction=0.0), MICRO_MOTOR)
    bench.advance(0.1, micro_a=0.3)
    # F t, less what the current loop's lag of 0.15 ms takes: 0.3 A x 30.3 N/A x (0.1 s - 0.15 ms)
    assert momentum(bench) == pytest.approx(9.09 * (0.1 - 0.15e-3), rel=1e-9)
    assert bench["macro_velocity_m_per_s"] == 0.0


def test_outer_force_is_the_whole_stage_times_acceleration():
    bench = Bench(effects(), JOINT | MACRO_MOTOR | {"damping_n_s_per_m": 50.0})
    bench.advance(0.5, macro_a=1.1)
    assert momentum(bench) == pytest.approx(1.1 * 99.0 * (0.5 - 0.15e-3), rel=1e-9)
    assert bench["end_velocity_m_per_s"] == pytest.approx(bench["macro_velocity_m_per_s"], rel=0.2)


# ---- energy ----------------------------------------------------------------------------------------------------


def released(damping=0.0, contact=0.0, **values) -> Bench:
    """Let the joint go from deep in the right contact, motors off."""
    bench = Bench(effects(contact=contact), JOINT | {"damping_n_s_per_m": damping} | values)
    place(bench.state, macro_position_m=1e-3)
    return bench


def test_damping_takes_energy_and_never_gives_it():
    bench = released(damping=20.0, contact=75.0)
    levels = [energy(bench.advance(k * 1e-3, bridges=OFF)) for k in range(2000)]
    assert max(np.diff(levels)) < 1e-9 * levels[0]
    assert levels[-1] < 0.2 * levels[0]


def test_without_damping_the_energy_stays():
    bench = released()
    first = energy(bench)
    levels = np.array([energy(bench.advance((k + 1) * 1e-3, bridges=OFF)) for k in range(2000)])
    assert 0.0 < np.max(np.abs(levels / first - 1.0)) < 5e-4  # what crossing an edge between substeps costs


def test_free_oscillation_is_the_one_of_the_books():
    """Two masses on K2, b2: x = x0 e^(-zeta t) (cos wd t + zeta / wd sin wd t) in the reduced mass."""
    bench = Bench(effects(), {"spring_n_per_m": 500.0, "damping_n_s_per_m": 30.0})
    place(bench.state, end_position_m=1e-4)
    reduced_kg = 70.0 * 40.0 / 110.0
    zeta = 30.0 / (2.0 * reduced_kg)
    damped = math.sqrt(500.0 / reduced_kg - zeta**2)
    for t_s in (0.1, 0.37, 1.0, 2.5):
        bench.advance(t_s, bridges=OFF)
        swing = math.exp(-zeta * t_s) * (math.cos(damped * t_s) + zeta / damped * math.sin(damped * t_s))
        assert bench["end_position_m"] - bench["macro_position_m"] == pytest.approx(1e-4 * swing, abs=1e-11)


# ---- statics of (5), corrected reading ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("micro_n", "x_b_m", "contact_n"),
    [
        # F2 + K2 x_b + K_r (x_b - b_r) = 0: x_b = (20 + 9870 x 176e-6) / 10370
        (-20.0, 2.0961542912247e-3, 18.9519228543877),
        # F2 + K2 x_b + K_l (x_b + b_l) = 0: x_b = -(20 + 13200 x 25.4e-6) / 13700
        (20.0, -1.4843270072993e-3, -19.2578364963504),
        # in the gap the spring alone carries: x_b = 0.05 / 500
        (-0.05, 1e-4, 0.0),
    ],
)
def test_static_contact(micro_n, x_b_m, contact_n):
    values = JOINT | {"damping_n_s_per_m": 225.0, "base_spring_n_per_m": 1e5}
    bench = Bench(effects(viscous=2000.0), values)
    bench.advance(20.0, micro_a=micro_n / 10.0)
    assert bench["macro_position_m"] - bench["end_position_m"] == pytest.approx(x_b_m, rel=1e-10)
    assert bench["contact_force_n"] == pytest.approx(contact_n, rel=1e-9, abs=1e-12)
    assert bench["macro_position_m"] == pytest.approx(0.0, abs=1e-12)  # reaction and joint cancel on the base


def test_contact_retards_the_macro_and_drives_the_end():
    bench = Bench(effects(), JOINT)
    place(bench.state, macro_position_m=276e-6)  # 100 um into the right contact: 0.987 N, and 0.138 N of spring
    bench.advance(1e-6, bridges=OFF)
    assert bench["contact_force_n"] == pytest.approx(0.987, rel=1e-6)
    assert bench["macro_acceleration_m_per_s2"] == pytest.approx(-(0.987 + 0.138) / 70.0, rel=1e-6)
    assert bench["end_acceleration_m_per_s2"] == pytest.approx((0.987 + 0.138) / 40.0, rel=1e-6)


@pytest.mark.parametrize("x_b_m", [-25.3e-6, 0.0, 175.9e-6])
def test_no_contact_in_the_gap(x_b_m):
    bench = Bench(effects(contact=1e4), JOINT | {"spring_n_per_m": 0.0})
    place(bench.state, macro_position_m=x_b_m)
    bench.advance(1e-3, bridges=OFF)
    assert bench["contact_force_n"] == 0.0
    assert bench["macro_position_m"] == x_b_m


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_contact_never_pulls(side):
    """With damping far above critical, an unclamped joint would hold the parting masses back."""
    bench = Bench(effects(contact=1e4), JOINT)
    place(bench.state, macro_velocity_m_per_s=side * 0.02)
    stiffness = 9.87e3 if side > 0.0 else 13.2e3
    would_pull = 0
    for k in range(8000):
        if k == 2000:
            place(bench.state, macro_velocity_m_per_s=-side * 0.05)  # torn apart while pressed
        bench.advance((k + 1) * 25e-6, bridges=OFF, longest_s=25e-6)
        assert bench["contact_side"] * bench["contact_force_n"] >= 0.0
        if bench["contact_side"] == -side:
            break
        if bench["contact_side"] != 0.0:
            push_n = stiffness * bench["penetration_m"] + 1e4 * bench["penetration_velocity_m_per_s"]
            would_pull += push_n < 0.0
            assert abs(bench["contact_force_n"]) == pytest.approx(max(push_n, 0.0), abs=1e-9)
    assert would_pull > 3


# ---- motors (3), (4) ------------------------------------------------------------------------------------------


def test_current_loop_is_one_time_constant():
    bench = Bench(effects(), MICRO_MOTOR | {"micro_mass_kg": HARD, "macro_mass_kg": HARD, "micro_supply_v": 1e6})
    bench.advance(0.15e-3, micro_a=2.0)
    assert bench["micro_current_a"] == pytest.approx(2.0 * (1.0 - math.exp(-1.0)), rel=1e-12)
    bench.advance(3e-3, micro_a=2.0)
    assert bench["micro_current_a"] == pytest.approx(2.0, rel=1e-8)
    assert bench["micro_force_n"] == pytest.approx(60.6, rel=1e-8)  # 30.3 N/A x 2 A


def test_force_of_a_substep_is_the_mean_of_its_current():
    bench = Bench(effects(), MICRO_MOTOR | {"micro_mass_kg": HARD, "macro_mass_kg": HARD, "micro_supply_v": 1e6})
    bench.advance(0.3e-3, micro_a=2.0, longest_s=0.3e-3)
    # one substep of two time constants: 2 A (1 - (1 - e^-2) / 2)
    assert bench["micro_force_n"] == pytest.approx(30.3 * 2.0 * (1.0 - (1.0 - math.exp(-2.0)) / 2.0), rel=1e-12)


def test_current_stays_within_the_drives_limit():
    bench = Bench(effects(), MICRO_MOTOR | {"micro_mass_kg": HARD, "macro_mass_kg": HARD})
    for command_a, current_a in ((10.0, 6.0), (-10.0, -6.0), (5.9, 5.9)):
        bench.advance(bench["t_s"] + 0.01, micro_a=command_a)
        assert bench["micro_current_a"] == pytest.approx(current_a, rel=1e-9)


def test_supply_voltage_bounds_the_rise_of_current():
    """6 A at once would take 100 V; with 48 V, i = U / R (1 - e^(-t R / L)) until the loop takes over."""
    bench = Bench(effects(), MICRO_MOTOR | {"micro_mass_kg": HARD, "macro_mass_kg": HARD})
    bench.advance(0.1e-3, micro_a=6.0, longest_s=10e-6)
    assert bench["micro_current_a"] == pytest.approx(48.0 / 0.76 * (1.0 - math.exp(-0.1e-3 * 0.76 / 2.52e-3)), rel=2e-3)
    bench.advance(2e-3, micro_a=6.0, longest_s=10e-6)
    assert bench["micro_current_a"] == pytest.approx(6.0, rel=1e-4)


def test_back_emf_bounds_the_speed():
    """No more than U / Ke = 300 / 99 = 3.03 m/s, whatever the current asked for."""
    bench = Bench(effects(), MACRO_MOTOR | {"macro_mass_kg": 5.0, "has_micro": 0.0})
    bench.advance(2.0, macro_a=20.0)
    assert bench["macro_velocity_m_per_s"] == pytest.approx(300.0 / 99.0, rel=1e-3)
    assert abs(bench["macro_current_a"]) < 0.2


def test_shorted_winding_follows_its_electrical_time_constant():
    bench = Bench(effects(), MACRO_MOTOR | {"macro_mass_kg": HARD, "has_micro": 0.0})
    place(bench.state, macro_velocity_m_per_s=0.1)
    bench.advance(9.37e-3 / 2.75, bridges=(BRIDGE_SHORTED, BRIDGE_OFF))
    assert bench["macro_current_a"] == pytest.approx(-99.0 * 0.1 / 2.75 * (1.0 - math.exp(-1.0)), rel=1e-6)


def test_shorted_macro_stops_in_millimetres():
    """The current's area is the momentum: x = (m1 + m2) R v / (Kf Ke) = 110 x 2.75 x 0.2 / 99^2 = 6.173 mm."""
    bench = Bench(effects(), JOINT | MACRO_MOTOR | {"damping_n_s_per_m": 200.0})
    place(bench.state, macro_velocity_m_per_s=0.2, end_velocity_m_per_s=0.2)
    bench.advance(30.0, bridges=(BRIDGE_SHORTED, BRIDGE_OFF))
    assert bench["macro_position_m"] == pytest.approx(6.1728e-3, rel=1e-3)
    assert abs(bench["macro_velocity_m_per_s"]) < 1e-6


def test_bridge_off_means_no_current_at_once():
    bench = Bench(effects(), MACRO_MOTOR)
    bench.advance(0.05, macro_a=2.0)
    speed = bench["macro_velocity_m_per_s"]
    bench.advance(0.1, macro_a=2.0, bridges=OFF)
    assert bench["macro_current_a"] == 0.0
    assert bench["macro_velocity_m_per_s"] == speed  # it coasts


def test_the_voice_coil_feels_relative_speed():
    bench = Bench(effects(), MICRO_MOTOR | {"micro_mass_kg": HARD, "macro_mass_kg": HARD})
    place(bench.state, macro_velocity_m_per_s=0.3, end_velocity_m_per_s=0.2)
    bench.advance(0.1, bridges=(BRIDGE_OFF, BRIDGE_SHORTED))
    assert bench["micro_current_a"] == pytest.approx(30.3 * 0.1 / 0.76, rel=1e-6)
    both = Bench(effects(), MICRO_MOTOR)
    place(both.state, macro_velocity_m_per_s=0.3, end_velocity_m_per_s=0.3)
    both.advance(0.1, bridges=(BRIDGE_OFF, BRIDGE_SHORTED))
    assert both["micro_current_a"] == 0.0


# ---- hard stops -----------------------------------------------------------------------------------------------

TRAVEL = {
    "travel_low_m": -0.5,
    "travel_high_m": 0.5,
    "travel_stiffness_n_per_m": 5e5,
    "travel_damping_n_s_per_m": 5e3,
    "has_micro": 0.0,
}


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_pressed_stop_gives_way_by_force_over_stiffness(side):
    bench = Bench(effects(), TRAVEL)
    place(bench.state, macro_position_m=side * 0.499)
    bench.advance(2.0, macro_a=side * 10.0)  # 100 N on 5e5 N/m: 0.2 mm
    assert bench["macro_position_m"] == pytest.approx(side * 0.5002, abs=1e-9)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_stop_throws_back_and_never_holds(side):
    bench = Bench(effects(), TRAVEL | {"travel_damping_n_s_per_m": 0.0})
    place(bench.state, macro_position_m=side * 0.4995, macro_velocity_m_per_s=side * 0.05)
    deepest_m = max(side * bench.advance((k + 1) * 1e-4)["macro_position_m"] for k in range(600))
    # v sqrt(m / k) = 0.05 sqrt(70 / 5e5)
    assert deepest_m - 0.5 == pytest.approx(0.05 * math.sqrt(70.0 / 5e5), rel=1e-3)
    assert side * bench["macro_velocity_m_per_s"] == pytest.approx(-0.05, rel=1e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_stroke_ends_at_stops_that_conserve_momentum(side):
    stroke = {"stroke_low_m": -1e-3, "stroke_high_m": 1e-3}
    stroke |= {"stroke_stiffness_n_per_m": 2e5, "stroke_damping_n_s_per_m": 2e3}
    bench = Bench(effects(), stroke)
    place(bench.state, end_velocity_m_per_s=side * 0.1)
    furthest_m = max(
        side * (bench.advance((k + 1) * 1e-4, bridges=OFF)["end_position_m"] - bench["macro_position_m"])
        for k in range(500)
    )
    assert 1e-3 < furthest_m < 1e-3 + 0.1 * math.sqrt(25.4545 / 2e5)
    assert momentum(bench) == pytest.approx(side * 4.0, rel=1e-12)
    assert side * (bench["end_velocity_m_per_s"] - bench["macro_velocity_m_per_s"]) < 0.0
    pressed = Bench(effects(), stroke)
    pressed.advance(3.0, micro_a=side * 2.0)  # 20 N of reaction-coupled force on 2e5 N/m: 0.1 mm
    assert pressed["end_position_m"] - pressed["macro_position_m"] == pytest.approx(side * 1.1e-3, abs=1e-8)


def test_base_spring_pulls_back():
    bench = Bench(effects(viscous=2000.0), {"base_spring_n_per_m": 1e4, "has_micro": 0.0})
    bench.advance(10.0, macro_a=3.0)
    assert bench["macro_position_m"] == pytest.approx(3e-3, rel=1e-9)  # 30 N / 1e4 N/m


# ---- one axis -------------------------------------------------------------------------------------------------


def test_without_a_micro_the_end_is_the_macro():
    bench = Bench(effects(viscous=5.0), {"has_micro": 0.0, "micro_mass_kg": 1.0})
    bench.advance(0.7, macro_a=1.0, micro_a=5.0)
    assert bench["end_position_m"] == bench["macro_position_m"] > 0.0
    assert bench["end_velocity_m_per_s"] == bench["macro_velocity_m_per_s"]
    # m v' = F - b v after the loop's lag: v = F / b (1 - e^(-b t / m))
    assert bench["macro_velocity_m_per_s"] == pytest.approx(
        2.0 * (1.0 - math.exp(-5.0 * (0.7 - 0.15e-3) / 70.0)), rel=1e-6
    )


# ---- the integrator -------------------------------------------------------------------------------------------


def smooth(longest_s: float) -> Bench:
    """Swing on springs and dampers with a held current: no edge is crossed, so the order shows."""
    values = {"spring_n_per_m": 2e4, "damping_n_s_per_m": 300.0, "base_spring_n_per_m": 1e5} | MACRO_MOTOR
    bench = Bench(effects(viscous=400.0), values)
    place(bench.state, end_position_m=2e-4, macro_velocity_m_per_s=0.01)
    return bench.advance(0.2, macro_a=1.0, micro_a=0.2, longest_s=longest_s)


@pytest.mark.parametrize("name", ["macro_position_m", "end_position_m", "end_velocity_m_per_s"])
def test_halving_the_substep_quarters_the_error(name):
    truth = smooth(1e-6)[name]
    errors = [abs(smooth(substep_s)[name] - truth) for substep_s in (400e-6, 200e-6, 100e-6, 50e-6)]
    for coarse, fine in itertools.pairwise(errors):
        assert 3.5 < coarse / fine < 4.6
    assert errors[-1] < 1e-8


def test_position_integral_is_the_mean_times_the_time():
    bench = Bench(effects(), {"spring_n_per_m": 0.0})
    place(bench.state, end_velocity_m_per_s=0.2, macro_velocity_m_per_s=-0.1)
    bench.advance(0.5, bridges=OFF)
    assert bench["end_position_integral_m_s"] == pytest.approx(0.2 * 0.5**2 / 2.0, rel=1e-12)
    assert bench["macro_position_integral_m_s"] == pytest.approx(-0.1 * 0.5**2 / 2.0, rel=1e-12)


def test_the_same_run_twice_is_equal_to_the_last_bit():
    assert smooth(50e-6).state.tobytes() == smooth(50e-6).state.tobytes()


@settings(max_examples=25)
@given(st.lists(st.floats(1e-6, 0.0999), min_size=1, max_size=30), st.sampled_from(["gap", "contact"]))
def test_arbitrary_instants_on_the_way_change_nothing(instants_s, where):
    """The rig is advanced to whatever is asked: SYNC, a sample, an arrival."""
    joint = JOINT if where == "contact" else JOINT | {"left_m": HARD, "right_m": HARD}

    def thrown() -> Bench:
        bench = Bench(effects(contact=75.0), joint | MICRO_MOTOR)
        place(bench.state, macro_velocity_m_per_s=5e-3)
        return bench

    straight = thrown().advance(0.1, micro_a=0.1)
    split = thrown()
    for t_s in sorted(instants_s):
        split.advance(t_s, micro_a=0.1)
    split.advance(0.1, micro_a=0.1)
    assert split["t_s"] == straight["t_s"] == 0.1
    # where an edge falls between substeps is first order: 5 mm/s on 10 N/mm
    allowed_m = 5e-9 if where == "contact" else 1e-11
    assert split["end_position_m"] == pytest.approx(straight["end_position_m"], abs=allowed_m)
    assert split["macro_position_m"] == pytest.approx(straight["macro_position_m"], abs=allowed_m)


# ---- noise ----------------------------------------------------------------------------------------------------

NOISE = {"macro_noise_n": 0.1, "micro_noise_n": 0.005, "draws_noise": 1.0}


def drawn(seed: int, instants_s, longest_s: float = 50e-6) -> np.ndarray:
    """Return (macro, micro) force noise in force just before each instant, N."""
    bench = Bench(effects(), NOISE | {"seed": seed})
    rows = []
    for t_s in instants_s:
        bench.advance(t_s, longest_s=longest_s)
        rows.append((bench["macro_disturbance_n"], bench["micro_disturbance_n"]))
    return np.array(rows)


def test_noise_depends_on_time_and_seed_only():
    grid_s = np.arange(1, 200) * 1e-3
    expected = drawn(7, grid_s)
    np.testing.assert_array_equal(drawn(7, grid_s, 13e-6), expected)
    finer_s = np.sort(np.concatenate([grid_s, grid_s - 0.3e-3, grid_s - 0.47e-3]))
    np.testing.assert_array_equal(drawn(7, finer_s)[2::3], expected)
    late = drawn(7, grid_s[100:])  # not how the noise came there, but when it is
    np.testing.assert_array_equal(late, expected[100:])
    assert not np.any(drawn(8, grid_s) == expected)


def test_noise_is_white_and_of_the_size_asked_for():
    values = drawn(3, np.arange(1, 20001) * 1e-3, 1e-3)
    for column, size_n in ((0, 0.1), (1, 0.005)):
        series = values[:, column]
        assert abs(np.mean(series)) < 4.0 * size_n / math.sqrt(20000)
        assert np.std(series) == pytest.approx(size_n, rel=0.02)
        assert abs(np.corrcoef(series[1:], series[:-1])[0, 1]) < 4.0 / math.sqrt(20000)
        assert 3.0 < np.max(np.abs(series)) / size_n < 6.0
    assert abs(np.corrcoef(values.T)[0, 1]) < 4.0 / math.sqrt(20000)


def test_a_belief_draws_no_noise():
    bench = Bench(effects(), NOISE | {"draws_noise": 0.0})
    place(bench.state, macro_disturbance_n=2.0)
    bench.advance(0.1)
    assert bench["macro_disturbance_n"] == 2.0  # an observer's own, felt as it stands
    assert bench["macro_velocity_m_per_s"] == pytest.approx(2.0 * 0.1 / 70.0, rel=1e-12)


# ---- effects beside force and contact -------------------------------------------------------------------------


def test_edges_of_the_gap_lie_where_effects_put_them():
    """176 um + 10 / 2 + 3 right, 25.4 um + 10 / 2 - 3 left: 2 um beyond each there are 2 um x K."""
    moved = [table("backlash_width_change", change_m=10e-6), table("backlash_centre_shift", shift_m=3e-6)]
    for x_b_m, force_n in ((186e-6, 9.87e3 * 2e-6), (-29.4e-6, -13.2e3 * 2e-6), (183.9e-6, 0.0), (-27.3e-6, 0.0)):
        bench = Bench(moved, JOINT | {"spring_n_per_m": 0.0})
        place(bench.state, macro_position_m=x_b_m)
        bench.advance(1e-9, bridges=OFF)
        assert bench["contact_force_n"] == pytest.approx(force_n, rel=1e-6)


def test_a_narrower_gap_has_contact_where_there_was_none():
    bench = Bench([table("backlash_width_change", change_m=-10e-6)], JOINT | {"spring_n_per_m": 0.0})
    place(bench.state, macro_position_m=173e-6)  # 3 um inside the old edge, 2 um beyond the new one
    bench.advance(1e-9, bridges=OFF)
    assert bench["contact_force_n"] == pytest.approx(9.87e3 * 2e-6, rel=1e-6)


def test_wear_counts_from_the_start_of_the_run():
    bench = Bench([table("backlash_wear", rate_m_per_s=1e-6)], JOINT | {"spring_n_per_m": 0.0})
    bench.advance(10.0, bridges=OFF, longest_s=1e-3)
    assert bench["right_edge_shift_m"] == pytest.approx(5e-6, rel=1e-3)
    assert bench["left_edge_shift_m"] == bench["right_edge_shift_m"]


def test_contact_effects_know_their_side_and_its_stiffness():
    wrong = [table("contact_stiffness_error", left_error_ratio=0.1, right_error_ratio=-0.2)]
    for x_b_m, force_n in ((276e-6, 0.8 * 0.987), (-125.4e-6, -1.1 * 1.32)):
        bench = Bench(wrong, JOINT | {"spring_n_per_m": 0.0})
        place(bench.state, macro_position_m=x_b_m)
        bench.advance(1e-9, bridges=OFF)
        assert bench["contact_force_n"] == pytest.approx(force_n, rel=1e-6)


def test_a_joint_effect_is_felt_by_both():
    bench = Bench([table("linear_stiffness", "joint", stiffness_n_per_m=2e3), table("cubic_stiffness", "joint")])
    place(bench.state, end_position_m=1e-3)  # 2 N + 1e9 x 1e-9 = 1 N
    bench.advance(1e-9, bridges=OFF)
    assert 40.0 * bench["end_acceleration_m_per_s2"] == pytest.approx(-3.0, rel=1e-6)
    for k in range(100):
        bench.advance((k + 1) * 5e-3, bridges=OFF)
        assert abs(momentum(bench)) < 1e-13


def test_a_wrong_mass_answers_with_another_acceleration():
    bench = Bench([table("mass_error", "macro_force", error_ratio=0.05)], {"has_micro": 0.0})
    bench.advance(0.2, macro_a=7.0)
    assert bench["macro_acceleration_m_per_s2"] == pytest.approx(70.0 / (70.0 * 1.05), rel=1e-12)
    assert bench["macro_velocity_m_per_s"] == pytest.approx(0.2 / 1.05, rel=2e-3)


def test_a_tilt_lets_both_slide_alike():
    bench = Bench([table("gravity_tilt", axis, grade_ratio=-1e-3) for axis in ("macro_force", "micro_force")])
    bench.advance(1.0)
    assert bench["macro_velocity_m_per_s"] == pytest.approx(9.80665e-3, rel=1e-12)
    assert bench["end_velocity_m_per_s"] == pytest.approx(9.80665e-3, rel=1e-12)


@pytest.mark.parametrize(
    ("share", "frequency_hz", "longest_s"), [(0.1, 60.0, 50e-6), (0.4, 200.0, 50e-6), (0.2, 80.0, 3e-4)]
)
def test_a_free_mode_rings_above_its_frequency_with_the_axis_held(share, frequency_hz, longest_s):
    """f / sqrt(1 - mu), damped by zeta / sqrt(1 - mu); the whole mass is what it was."""
    zeta = 0.02
    mode = table("flexible_mode", "macro_force", share_ratio=share, frequency_hz=frequency_hz, damping_ratio=zeta)
    bench = Bench([mode], {"has_micro": 0.0})
    bench.advance(1e-3, macro_a=7.0, longest_s=longest_s)
    t_s = 1e-3 + longest_s * np.arange(1, 4000)
    velocity = np.array([bench.advance(t, longest_s=longest_s)["macro_velocity_m_per_s"] for t in t_s])
    assert np.mean(velocity[-500:]) == pytest.approx(1e-3, rel=1e-2)  # 70 N x 1 ms / 70 kg
    ring = velocity - 1e-3
    free_hz = frequency_hz / math.sqrt(1.0 - share)
    free_zeta = zeta / math.sqrt(1.0 - share)
    crossings = np.flatnonzero((ring[20:-1] < 0.0) & (ring[21:] >= 0.0))[:6]
    assert (len(crossings) - 1) / ((crossings[-1] - crossings[0]) * longest_s) == pytest.approx(free_hz, rel=0.02)
    period = round(1.0 / free_hz / longest_s)
    swings = [np.max(np.abs(ring[100 + k * period : 100 + (k + 1) * period])) for k in range(6)]
    assert swings[5] / swings[0] == pytest.approx(math.exp(-10.0 * math.pi * free_zeta), rel=0.2)


@pytest.mark.parametrize("longest_s", [50e-6, 300e-6])
def test_a_mode_is_stable_at_the_observers_substep(longest_s):
    """Stepped with the axis' own acceleration it diverged at 200 Hz and 0.3 ms."""
    mode = table("flexible_mode", "macro_force", share_ratio=0.5, frequency_hz=500.0, damping_ratio=0.01)
    bench = Bench([mode], {"has_micro": 0.0})
    bench.advance(1e-3, macro_a=7.0, longest_s=longest_s)
    bench.advance(0.5, longest_s=longest_s)
    assert bench["macro_velocity_m_per_s"] == pytest.approx(1e-3, rel=1e-2)


def test_a_late_command_is_felt_late():
    bench = Bench([table("command_delay", "macro_command", delay_s=0.7e-3)], {"has_micro": 0.0})
    bench.advance(0.69e-3, macro_a=7.0)
    assert bench["macro_velocity_m_per_s"] == 0.0
    bench.advance(0.1, macro_a=7.0)
    # 1 m/s^2 from 0.7 ms on, less the current loop's 0.15 ms
    assert bench["macro_velocity_m_per_s"] == pytest.approx(0.1 - 0.85e-3, rel=1e-9)


def test_a_lagging_command_loses_its_time_constant():
    bench = Bench([table("current_loop_lag", "macro_command", time_constant_s=0.4e-3)], {"has_micro": 0.0})
    bench.advance(0.1, macro_a=7.0)
    assert bench["macro_velocity_m_per_s"] == pytest.approx(0.1 - 0.55e-3, rel=1e-9)


def test_pre_sliding_holds_what_coulomb_friction_lets_creep():
    """3 N of 4 N: Dahl stands off by -delta ln(1 - 3/4), and stays; coulomb_friction's tanh creeps."""
    damped = table("viscous_friction", damping_n_s_per_m=1e4)
    bench = Bench([table("dahl_friction", "macro_force", slip_m=5e-6), damped], {"has_micro": 0.0})
    for k in range(4000):
        bench.advance((k + 1) * 1e-3, macro_a=0.3 * min(1.0, k / 2000.0))
    assert bench["macro_position_m"] == pytest.approx(5e-6 * math.log(4.0), rel=0.02)
    assert abs(bench["macro_velocity_m_per_s"]) < 1e-9


def test_what_is_remembered_is_part_of_the_state():
    """A copy of the state goes on as the original does."""
    tables = [table("lugre_friction", "macro_force"), table("command_delay", "micro_command"), table("flexible_mode")]
    bench = Bench(tables, JOINT)
    bench.advance(0.05, macro_a=2.0, micro_a=0.4)
    other = Bench(tables, JOINT)
    other.state[...] = bench.state
    for one in (bench, other):
        one.advance(0.08, macro_a=-1.0, micro_a=0.1)
    assert bench.state.tobytes() == other.state.tobytes()
    assert np.any(bench.state["memory"] != 0.0)


def test_sense_is_what_the_sensors_add():
    tables = [
        table("sensor_delay", "end_sensor", delay_s=1e-3),
        table("sensor_lag", "macro_sensor", time_constant_s=1e-3),
        table("scale_error", "macro_sensor", error_ppm=10.0),
    ]
    bench = Bench(tables)
    place(bench.state, macro_velocity_m_per_s=0.1, end_velocity_m_per_s=0.2, macro_position_m=0.5)
    call = (bench.state, bench.parameters, bench.effect_parameters)
    first = bench.module.sense(*call, 1e-3)
    assert first == pytest.approx((5e-6 - 1e-4 * (1.0 - math.exp(-1.0)), -2e-4), rel=1e-12)
    assert bench.module.sense(*call, 0.0) == first  # no time, no change
    assert bench.module.sense(*call, 1.0) == pytest.approx((5e-6 - 1e-4, -2e-4), rel=1e-12)


# ---- from a machine file --------------------------------------------------------------------------------------


def test_parameters_are_the_machines(oled_machine):
    q = plant.parameters(oled_machine, seed=4)[0]
    assert (q["macro_mass_kg"], q["micro_mass_kg"]) == (70.7, 39.6)
    assert (q["left_m"], q["right_m"]) == (27.9e-6, 171.3e-6)
    assert (q["left_stiffness_n_per_m"], q["right_stiffness_n_per_m"]) == (12.9e3, 10.1e3)
    assert (q["stroke_low_m"], q["stroke_high_m"]) == (-0.001, 0.001)
    assert (q["travel_low_m"], q["travel_high_m"]) == (-0.5, 0.5)
    assert (q["macro_force_constant_n_per_a"], q["micro_force_constant_n_per_a"]) == (99.0, 30.3)
    assert (q["macro_resistance_ohm"], q["micro_inductance_h"]) == (2.75, 2.52e-3)
    assert (q["macro_noise_n"], q["micro_noise_n"], q["seed"], q["draws_noise"]) == (0.1, 0.005, 4.0, 1.0)
    assert (q["spring_n_per_m"], q["damping_n_s_per_m"], q["has_micro"]) == (500.0, 5.0, 1.0)
    s = plant.init(oled_machine)[0]
    assert (s["macro_position_m"], s["end_position_m"]) == (0.004, 0.00405)


def test_parameters_of_one_axis(single_machine):
    q = plant.parameters(single_machine)[0]
    assert q["has_micro"] == 0.0
    assert q["macro_mass_kg"] == 12.12
    s = plant.init(single_machine)[0]
    assert s["end_position_m"] == s["macro_position_m"] == 0.004
