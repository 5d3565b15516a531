"""Numbers as people read them."""

import math
import re

import pytest
from hypothesis import given
from hypothesis.strategies import floats

from maasi_filter.wording import counted, number, point


@given(floats(allow_nan=False, allow_infinity=False))
def test_numbers_have_three_significant_digits_and_zero_has_no_sign(value):
    text = number(value)
    assert float(text) == pytest.approx(value, rel=5.01e-3)
    if value == 0.0 or float(text) == 0.0:
        assert text == '0'
    mantissa = re.sub(r'e.*|[-.]', '', text).lstrip('0')
    assert len(mantissa) <= 3 or (abs(value) >= 100.0 and '.' not in text)


def test_infinite_numbers_points_and_counts():
    assert [number(value) for value in (float('inf'), float('nan'), -0.0)] == ['-', '-', '0']
    assert point([1.23456, -0.0, 1234.5]) == '(1.23, 0, 1234)'
    assert point([73.7, 4.5e-4]) == '(73.7, 0)'
    assert point([4.5e-4, math.nan]) == '(0.00045, -)'
    assert [counted(n, 'find') for n in range(3)] == ['0 finds', '1 find', '2 finds']
