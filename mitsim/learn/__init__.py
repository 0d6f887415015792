"""What networks learn from: pictures, and pairs of frames and truths that a camera would take of them."""
