"""Captures: light exposed as noisy frames, mono, by lines and behind colour filters; the reference estimator."""
