"""The image sensor: irradiance, noise, digital numbers, and how they are measured (EMVA 1288 release 4.0)."""
