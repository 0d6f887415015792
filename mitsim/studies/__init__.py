"""Experiments: capture, calibrate and reconstruct together, judged against the truth and shown to people."""
