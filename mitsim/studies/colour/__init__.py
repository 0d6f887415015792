"""Images of each line of the light and in colour, judged by spectra, from runs by line or behind colour filters."""
