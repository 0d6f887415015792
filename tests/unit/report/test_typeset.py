"""Numbers and texts as pages and figures print them."""

import pytest

from mitsim.report.pages import round_to_error, scientific, typeset

TIMES, MICRO = "\N{MULTIPLICATION SIGN}", "\N{GREEK SMALL LETTER MU}"


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("one anchor leaves 7.8e-04", f"one anchor leaves 7.8{TIMES}10⁻⁴"),
        ("condition 6.2e+06.", f"condition 6.2{TIMES}10⁶."),
        ("0.0e+00 of them, below 1e-3", "0 of them, below 10⁻³"),
        ("up to 9.4e-02 and 3.87e-02, 7.0e+02 of 1.0e+00", "up to 0.094 and 0.0387, 700 of 1.0"),
        ("512 x 512 pixels of 11.72 um", f"512 {TIMES} 512 pixels of 11.72 {MICRO}m"),
        ("3x3 anchors, -3.5 +- 0.1 dB", f"3{TIMES}3 anchors, -3.5 \N{PLUS-MINUS SIGN} 0.1 dB"),
        ("dots:7x16, abc1e-3, v1.2e3x, the um of 23 mm", "dots:7x16, abc1e-3, v1.2e3x, the um of 23 mm"),
    ],
)
def test_numbers_in_a_text_are_printed_and_names_are_left_alone(text: str, printed: str) -> None:
    """No pattern's name is a size, and no number 10 to the power of nothing."""
    assert typeset(text) == printed


@pytest.mark.parametrize(
    ("value", "printed"),
    [
        (None, "\N{EN DASH}"),
        (0.0, "0"),
        (0.011, "0.0110"),
        (1234.4, "1234"),
        (999.6, "1000"),
        (99.97, "100"),
        (2.6e-3, f"2.6{TIMES}10⁻³"),
        (-6.2e6, f"-6.2{TIMES}10⁶"),
    ],
)
def test_a_number_keeps_its_digits(value: float | None, printed: str) -> None:
    """Not 0.011 beside 0.0108, nor 1.23e+03 for 1234."""
    assert scientific(value) == printed


@pytest.mark.parametrize(
    ("value", "error", "printed"),
    [(0.66877, 0.00088, "0.66877"), (-3.8364e-4, 0.0012, "-0.0004"), (128_314.0, 880.0, "128310"), (1.5, 0.0, "1.5")],
)
def test_a_measured_number_ends_where_its_error_does(value: float, error: float, printed: str) -> None:
    """No digits of a number whose first one is not known."""
    assert round_to_error(value, error) == printed
