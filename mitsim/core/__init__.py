"""Basics that every stage shares: errors, units, named random streams, frames on disk, manifests, the machine."""
