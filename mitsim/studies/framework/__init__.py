"""Framework of studies of many points: experiment, workers, table, verdicts, page."""
