"""Calibration frames in, sensor factors out. Knows neither Mitsuba nor the scene."""
