"""How studies of many points run: experiment, workers, table, verdicts, page."""
