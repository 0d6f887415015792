"""The scene before the camera: checked scene files, projector grid, pattern families and the effect plan."""
