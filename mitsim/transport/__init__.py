"""Mitsuba plugins are provided here, and tracers that follow light from the projector to the camera."""
