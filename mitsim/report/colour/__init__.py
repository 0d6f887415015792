"""Images in colour."""
