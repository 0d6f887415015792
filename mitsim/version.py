"""The version of mitsim, for pyproject.toml, manifests and files."""

__version__ = "0.17.0"
