"""The composer: scene -> plan -> transport -> optics -> sensor -> frames. It alone sees all stages."""
