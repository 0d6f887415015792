"""Calibrations: sessions rendered or planned, and the factors that they give."""
