"""Lengths and fractions as text."""

import pytest

from tofuse.engine.quantities import count, length, one, percent, probability


def test_length_has_two_or_three_digits_that_matter():
    metres = (0.0, 0.00234, 0.00996, 0.024, 0.0996, 0.154, -12.0, float("inf"), None)
    texts = ["0.0 mm", "2.3 mm", "10 mm", "24 mm", "0.10 m", "0.15 m", "-12.00 m", "–", "–"]
    assert [length(m) for m in metres] == texts


@pytest.mark.parametrize(
    ("fraction", "text"),
    [(0.0, "0 %"), (0.0031, "0.3 %"), (0.05, "5 %"), (0.426, "43 %"), (0.9947, "99.5 %")],
)
def test_percent_has_a_decimal_where_it_matters(fraction, text):
    assert percent(fraction) == text


def test_all_is_not_claimed_for_less():
    assert (percent(0.9999), percent(1.0), percent(1.2)) == ("99.9 %", "100 %", "120 %")
    assert [probability(p) for p in (0.0, 0.97, 1.0)] == ["below 0.1 %", "97 %", "over 99.9 %"]
    assert percent(None) == percent(float("nan")) == "–"


def test_nouns_agree_with_numbers_and_articles():
    assert [count(n, "frame") for n in (0, 1, 12_000)] == ["0 frames", "1 frame", "12,000 frames"]
    assert [one(noun) for noun in ("int", "list", "ndarray")] == ["an int", "a list", "an ndarray"]
    assert [one(noun) for noun in ("uint8", "OrderedDict")] == ["a uint8", "an OrderedDict"]
