"""Samples for clients: thinned out with the greatest error, and no error where the line came late."""

import math

import numpy as np
import pytest

from stagectl.requests import Phase
from stagectl.row import new_rows
from stagectl.service.scope import COLUMNS, Scope

ERROR = COLUMNS.index("error_m")


def moving_rows(count, errors_m):
    rows = new_rows(count)
    rows["t_ns"] = 1_000_000 * np.arange(count)
    rows["cycle"] = rows["sequence"] = np.arange(count)
    rows["samples_new"] = 1
    rows["setpoint_position_m"] = 0.25e-3 * np.arange(count)
    rows["end_position_m"] = rows["setpoint_position_m"] + errors_m
    return rows


def test_a_sample_has_the_greatest_error_of_its_rows_with_its_sign():
    errors_m = np.zeros(20)
    errors_m[[3, 7, 12]] = 2e-6, -5e-6, 1e-6
    scope = Scope(1000.0)
    scope.add(moving_rows(13, errors_m[:13]))  # the rest of a sample waits for its rows
    assert [row[ERROR] for row in scope.after(0).rows] == [pytest.approx(-5e-6)]
    scope.add(moving_rows(20, errors_m)[13:])
    assert [row[ERROR] for row in scope.after(0).rows] == [pytest.approx(-5e-6), pytest.approx(1e-6)]


def test_a_late_line_is_no_error():
    rows = moving_rows(20, np.full(20, 1e-6))
    late = rows[4:6]
    late["sequence"] -= 1
    late["end_position_m"] -= 0.25e-3
    rows["samples_new"][10:] = 0
    scope = Scope(1000.0)
    scope.add(rows)
    first, second = (row[ERROR] for row in scope.after(0).rows)
    assert first == pytest.approx(1e-6)
    assert math.isnan(second)


def test_what_swings_without_power_is_no_error_of_a_sample_with_it():
    errors_m = np.full(30, 1e-6)
    errors_m[[8, 25]] = 1e-4
    rows = moving_rows(30, errors_m)
    rows["run_phase"] = Phase.TRACKING
    rows["run_phase"][[6, 7, 8, 9]] = Phase.IDLE
    rows["run_phase"][20:26] = Phase.IDLE
    scope = Scope(1000.0)
    scope.add(rows)
    assert [row[ERROR] for row in scope.after(0).rows] == [
        pytest.approx(1e-6),
        pytest.approx(1e-6),
        pytest.approx(1e-4),
    ]
