"""A session file has the options of several verbs; this room runs it into one folder, and writes it from a folder."""
