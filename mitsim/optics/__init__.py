"""Mask geometry and its shadow: from a coded mask and light per direction to irradiance on the sensor."""
