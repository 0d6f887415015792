"""Experiments composed of capture, calibration and reconstruction; image quality; the HTML report."""
