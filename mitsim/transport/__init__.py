"""Light from the projector to the camera: Mitsuba plugins and the light-transport estimator."""
