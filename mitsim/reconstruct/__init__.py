"""Frames, factors and patterns in; images out. Knows neither Mitsuba nor the truth."""
