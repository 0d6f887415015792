"""The plan of a capture: pilot runs in; the cheapest settings that keep an accuracy, and why, out."""
