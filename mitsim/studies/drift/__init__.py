"""What moves between calibration and capture, and what it costs an image."""
