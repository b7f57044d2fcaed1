"""Fields of a structured record as plain attributes: on the same memory, both ways."""

import numpy as np
import pytest

from stagectl.errors import RequestError
from stagectl.fields import fields
from stagectl.requests import STATUS
from stagectl.signals import MEASUREMENT, SETPOINT, new


def test_store_writes_every_field_where_the_array_has_it():
    record = new(MEASUREMENT)
    seen = fields(record)
    for number, name in enumerate(MEASUREMENT.names or ()):
        setattr(seen, name, number + 1)
    seen.store()
    assert [record[name][0] for name in MEASUREMENT.names or ()] == list(range(1, len(MEASUREMENT.names or ()) + 1))


def test_load_reads_plain_numbers():
    record = new(SETPOINT)
    hold = fields(record)
    record["velocity_m_per_s"] = 0.125
    record["jerk_m_per_s3"] = np.nan
    assert hold.velocity_m_per_s == 0.0  # not yet
    hold.load()
    assert hold.velocity_m_per_s == 0.125
    assert type(hold.velocity_m_per_s) is float
    assert np.isnan(hold.jerk_m_per_s3)


def test_arrays_at_the_end_are_left_alone():
    record = np.zeros(1, STATUS)
    record["text"][0, 0] = 65
    stated = fields(record)
    stated.rows = 7
    stated.store()
    assert record["rows"][0] == 7
    assert record["text"][0, 0] == 65


@pytest.mark.parametrize("dtype", [[("a", "f8"), ("b", "i4")], [("a", "u1", (8,)), ("b", "f8"), ("c", "f8")], "f8"])
def test_a_layout_that_is_not_of_eight_byte_scalars_is_refused(dtype):
    with pytest.raises(RequestError, match="fields are"):
        fields(np.zeros(1, dtype))


def test_a_field_of_whole_numbers_takes_no_fraction():
    record = new(MEASUREMENT)
    seen = fields(record)
    seen.cycle = 1.5
    with pytest.raises(Exception, match="integer"):
        seen.store()
