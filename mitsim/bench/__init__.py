"""The bench: a loaded scene with camera and projector, the effects that it can have, and what is asked of it."""
