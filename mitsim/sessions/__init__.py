"""Sessions: one file with the options of several verbs, one folder with their results, and the way back."""
