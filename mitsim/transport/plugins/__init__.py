"""Mitsuba plugins of mitsim."""
