"""The codec's quick look at half floats finds what NumPy's own comparison finds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.codec import RefusedError, _extremes, check
from tests import samples


@given(st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=20), st.booleans())
def test_extremes_of_any_half_floats_are_those_of_numpy(bits, negative):
    values = np.array([b if negative else b & 0x7FFF for b in bits], dtype="<u2").view("<f2")
    assert np.array_equal(np.array(_extremes(values)), np.array([values.min(), values.max()]), equal_nan=True)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, -0.5])
def test_one_wrong_cell_in_a_volume_is_refused(wrong):
    risk = samples.risk()
    volume = np.asarray(risk.volume, dtype="<f2").copy()
    volume[-1, -1, -1] = wrong
    with pytest.raises(RefusedError):
        check(samples.risk(volume=volume))
