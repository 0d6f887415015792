"""What a bench is made of, as pure data that every stage may see: camera, mask, sensor, projector, patterns, recipe."""
