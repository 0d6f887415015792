"""Mask geometry and its shadow: from a coded mask and a sensor to separable linear operators."""
