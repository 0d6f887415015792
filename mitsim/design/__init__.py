"""Expected quality of images by cause, from which cameras and patterns are designed."""
