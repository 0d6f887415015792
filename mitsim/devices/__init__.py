"""The devices as pure data: camera, mask, sensor, projector, patterns, session; no renderer."""
