"""Learning: pictures, pairs of frames and truths, training, and trained networks as solvers."""
