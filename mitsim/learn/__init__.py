"""What networks learn from: pictures, and pairs of frames and truths; their training; trained networks as solvers."""
