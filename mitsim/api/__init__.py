"""Verbs of a bench; the objects themselves are data of the floors below."""
