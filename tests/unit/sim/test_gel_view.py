"""An encoded image returns its view, and no two are equal."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slipguard.sim.gel_view import GelView, decode_view, encode_view

numbers = st.floats(-1e6, 1e6)


@given(st.lists(numbers, min_size=7, max_size=7), st.tuples(numbers, numbers, numbers), st.booleans())
def test_an_encoded_view_is_decoded(values: list[float], light: tuple[float, float, float], there: bool) -> None:
    view = GelView("object" if there else "", *values)
    image = encode_view(view, light, 3)
    assert image.shape == (320, 240, 3)
    assert image.dtype == np.uint8
    assert decode_view(image) == (view, light)


def test_two_of_the_same_view_differ_in_every_row() -> None:
    one, other = (encode_view(GelView(""), (0.0, 0.0, 0.0), number) for number in (1, 2))
    assert (one != other).any(axis=(1, 2)).all()
